import json
import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

import numpy as np
import pytest

from drivers.frames import NO_INTENSITY, LaserScan, OdometrySample
from service.cli import main
from service.encoding import encode_event, encode_frame, encode_tf_static
from service.errors import ConfigError, InputError, StorageError
from service.geometry.se2 import SE2
from service.mapper.profiles import mapping_config, with_profile
from service.offline.cluster.batch import run_batch
from service.offline.cluster.engines import Processes
from service.offline.cluster.tasks import new_tasks
from service.offline.replay.replay import (
    ReplayOptions,
    group_sessions,
    replay,
    replay_all,
    result_folders,
    write_replay,
)
from service.offline.score.trajectory import read_tum
from service.recording.mcap_recorder import McapRecorder
from tests.service.recording.sessions import write_file
from tests.soaked import in_soak

T0_NS = 1_700_000_000_000_000_000
BEAMS = 271
CONFIG = """\
vehicle: v
sensors: {front: {type: sick_lms100, host: a, mounting: {x_m: %s}}}
recording: {directory: s}
map: {directory: m}
"""


def room_scan(stamp_ns: int, x_m: float) -> LaserScan:
    """A laser at (x, 0) in a room from -4 to 6 m by -3 to 3 m, looking along x."""
    angle = np.radians(np.linspace(-135.0, 135.0, BEAMS))
    with np.errstate(divide="ignore"):
        to_side = 3.0 / np.abs(np.sin(angle))
        to_end = np.where(np.cos(angle) > 0.0, 6.0 - x_m, 4.0 + x_m) / np.abs(np.cos(angle))
    range_m = np.minimum(to_side, to_end).astype(np.float32)
    step = math.radians(270.0) / (BEAMS - 1)
    period_ns = 20_000_000
    return LaserScan(
        "front",
        stamp_ns,
        stamp_ns + period_ns,
        0,
        period_ns,
        angle[0],
        step,
        0.05,
        20.0,
        range_m,
        NO_INTENSITY,
    )


def odometry_at(k: int, x_m: float, start_ns: int = T0_NS) -> OdometrySample:
    """As it comes before scan k."""
    stamp_ns = start_ns + k * 20_000_000
    return OdometrySample("base", stamp_ns, stamp_ns + 1_000_000, x_m, 0.0, 0.0, (0.5, 0.0, 0.0), (0.0,) * 9)


RecordDrive = Callable[..., Path]


def recorder_in(folder: Path) -> RecordDrive:
    """Records half a metre a second through the room; the laser is at the base's origin."""

    def record(
        name: str = "v",
        scans: int = 40,
        config: str | None = CONFIG % 0.0,
        late: bool = False,
        start_ns: int = T0_NS,
        requests: Mapping[int, str] = MappingProxyType({}),
        rear_scans: int = 0,
        one_topic: bool = False,
        covered: Collection[int] = (),
        samples: Mapping[int, OdometrySample] = MappingProxyType({}),
        mounted: str = "front",
    ) -> Path:
        metadata = {"config": {"yaml": config}} if config is not None else {}
        recorder = McapRecorder(folder / "in", name, keep_free_bytes=0, metadata=metadata)
        recorder.start()
        recorder.put(encode_tf_static({mounted: SE2()}, start_ns, start_ns))
        for k, request in requests.items():
            log_ns = start_ns + k * 20_000_000 + 1
            recorder.put(encode_event(json.dumps({"event": request}), log_ns, log_ns))
        for k in range(scans):
            stamp_ns, x_m = start_ns + k * 20_000_000, 0.01 * k
            sample = samples.get(k, odometry_at(k, x_m, start_ns))
            recorder.put(encode_frame(sample, log_ns=stamp_ns + 1_000_000))
            scan = room_scan(stamp_ns, x_m)
            blind = replace(scan, range_m=np.full(BEAMS, np.nan, np.float32))
            recorder.put(encode_frame(blind if k in covered else scan))
            if k < rear_scans:  # arrives before the scan of the front laser, yet is the newer of the two
                rear = replace(room_scan(stamp_ns + 1_000_000, x_m), sensor="rear")
                message = encode_frame(rear, log_ns=stamp_ns + 1_500_000)
                recorder.put(replace(message, channel="front/scan") if one_topic else message)
        if late:
            recorder.put(
                encode_frame(room_scan(start_ns, 0.0), log_ns=start_ns + scans * 20_000_000 + 30_000_000)
            )
        (session,) = recorder.finish()
        return session

    return record


@pytest.fixture
def record_drive(tmp_path: Path) -> RecordDrive:
    return recorder_in(tmp_path)


TWO_LASERS = CONFIG.replace("}}}", "}}, rear: {type: hokuyo_utm30lx, host: b, mounting: {x_m: %s}}}") % (0, 0)


@pytest.mark.parametrize(
    ("config", "mapped", "others"),
    [
        (TWO_LASERS, 70, 0),
        (TWO_LASERS + "mapping: {lasers: [front]}\n", 40, 30),
        (TWO_LASERS + "mapping: {lasers: [rear]}\n", 30, 40),
        (None, 40, 30),  # of a foreign recording those whose mounting is known
    ],
)
def test_lasers_are_mapped_as_the_config_says(
    record_drive: RecordDrive, config: str | None, mapped: int, others: int
):
    done = replay([record_drive(config=config, rear_scans=30)], ReplayOptions())
    assert (done.summary["scans"], done.summary["scans_not_mapped"]) == (mapped, others)
    assert done.summary["scans_dropped"] == 0
    # The first 25 scans of a further laser are compared with the map only.
    compared = [line for line in done.summary["warnings"] if "scans are not in the map" in line]
    assert bool(compared) == (mapped == 70)


def test_a_second_laser_in_the_topic_of_the_first_is_refused_and_named(
    record_drive: RecordDrive, caplog: pytest.LogCaptureFixture
):
    plain = replay([record_drive("v")], ReplayOptions())
    assert plain.summary["shared_topics"] == {}
    shared = replay([record_drive("w", rear_scans=30, one_topic=True)], ReplayOptions())
    assert shared.poses_map_base == plain.poses_map_base
    assert shared.summary["shared_topics"] == {
        "/front/scan": {
            "rear": {"messages": 30, "sensor": None},
            "front": {"messages": 40, "sensor": "front"},
        }
    }
    assert (shared.summary["scans"], shared.summary["scans_dropped"]) == (40, 0)
    assert (
        "/front/scan has messages of several frame_ids: 30 of rear, refused; 40 of front, read as front"
        in caplog.text
    )


def test_another_profile_maps_the_same_laser():
    outline_m = ((0.2, 0.2), (-0.2, 0.2), (0.0, -0.2))
    mapping = mapping_config({"lasers": ("rear",), "cell_m": 0.1, "outline_m": outline_m})
    other = with_profile("imle", mapping)
    assert (other.profile, other.lasers, other.cell_m) == ("imle", ("rear",), 0.1)
    assert other.outline_m == outline_m


def test_a_config_that_does_not_know_the_lasers_maps_the_fullest(record_drive: RecordDrive, tmp_path: Path):
    """As it is for a recording of another system, and not so where the config names one."""
    session = record_drive(config=None, rear_scans=30)
    config = tmp_path / "c.yaml"
    config.write_text((CONFIG % 0.0).replace("front", "other"))
    assert replay([session], ReplayOptions(config=config)).summary["scans"] == 40
    config.write_text((CONFIG % 0.0).replace("front", "rear"))
    assert replay([session], ReplayOptions(config=config)).summary["scans"] == 30
    config.write_text((CONFIG % 0.0).replace("front", "other") + "mapping: {lasers: [other]}\n")
    with pytest.raises(InputError, match="maps other"):
        replay([session], ReplayOptions(config=config))


def test_a_laser_that_the_recording_does_not_hold_is_reported(record_drive: RecordDrive):
    session = record_drive(config=TWO_LASERS + "mapping: {lasers: [rear]}\n")
    with pytest.raises(InputError, match=r"maps rear, but the scans here are of front; .*--config"):
        replay([session], ReplayOptions())


def test_a_replay_writes_what_other_programs_read(record_drive: RecordDrive, tmp_path: Path):
    done = replay([record_drive()], ReplayOptions())
    write_replay(done, tmp_path / "out")
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        "trajectory.tum",
        "trajectory_live.tum",
        "states.csv",
        "graph.g2o",
        "map.pgm",
        "map.yaml",
        "map.png",
        "map",
        "summary.json",
    }
    trajectory = read_tum(tmp_path / "out" / "trajectory.tum")
    assert trajectory.stamp_ns.tolist() == [T0_NS + k * 20_000_000 for k in range(40)]
    np.testing.assert_allclose(trajectory.pose[:, 0], 0.01 * np.arange(40), atol=0.01)
    np.testing.assert_allclose(trajectory.pose[:, 1], 0.0, atol=0.01)
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary == done.summary


def test_the_summary_counts_what_happened(record_drive: RecordDrive):
    done = replay([record_drive(late=True)], ReplayOptions())
    summary = done.summary
    assert list(summary) == [
        "corridor", "profile", "recording", "scans", "scans_dropped", "scans_not_mapped", "scans_passed_over",
        "scans_paused", "scans_before_odometry", "samples_dropped", "covariances_ignored", "unmounted",
        "shared_topics", "duration_s", "wall_s", "realtime_factor", "scan_ms", "scan_cpu_ms",
        "stage_ms_p50",
        "loop_closures", "keyframes", "peak_rss_mb", "map_tiles", "map_resets", "state",
        "state_reasons", "fixes",
        "geo_reference", "sensors", "mountings", "mapping", "warnings",
    ]  # fmt: skip
    assert (summary["scans"], summary["scans_dropped"]) == (40, 1)
    assert summary["duration_s"] == pytest.approx(39 * 0.02)
    assert summary["scan_ms"].keys() == {"p50", "p95", "p99", "max"}
    assert summary["scan_cpu_ms"].keys() == summary["scan_ms"].keys()
    assert 0.0 < summary["scan_cpu_ms"]["p50"] <= summary["scan_ms"]["p50"]
    assert summary["stage_ms_p50"].keys() == {"deskew", "match", "insert"}
    assert sum(summary["state"].values()) == 40
    assert summary["state_reasons"].keys() == {"degraded", "lost"}
    assert summary["map_tiles"] > 0
    assert summary["keyframes"] == done.g2o.count("VERTEX_SE2") == 2  # one each 0.3 m
    assert 50 < summary["peak_rss_mb"] < 2000


def test_a_laser_that_is_mounted_nowhere_is_a_warning(
    record_drive: RecordDrive, tmp_path: Path, caplog: pytest.LogCaptureFixture
):
    session = record_drive(config=None, mounted="other")
    assert replay([session], ReplayOptions()).summary["unmounted"] == ["front"]
    (facts,) = [record for record in caplog.records if "mounted at the base's origin" in record.message]
    assert facts.levelname == "WARNING"
    assert "/tf_static does not lead from front to base_link or base_footprint" in facts.message
    assert "by --config" in facts.message
    caplog.clear()
    (tmp_path / "c.yaml").write_text(CONFIG % 0.0)
    done = replay([session], ReplayOptions(config=tmp_path / "c.yaml"))
    assert done.summary["unmounted"] == []
    assert "mounted at" not in caplog.text


def test_samples_that_are_not_used_are_counted(record_drive: RecordDrive, caplog: pytest.LogCaptureFixture):
    summary = replay([record_drive("v")], ReplayOptions()).summary
    none = {"late": 0, "same_stamp": 0, "stamp": 0, "clock": 0, "waiting": 0, "unusable": 0}
    assert (summary["samples_dropped"], summary["covariances_ignored"]) == (none, 0)
    samples = {
        6: odometry_at(5, 0.05),  # a stamp that was there
        7: odometry_at(4, 0.04),
        8: replace(odometry_at(8, 0.08), theta_rad=math.nan),
        9: replace(odometry_at(9, 0.09), covariance=(math.nan,) * 9),
    }
    summary = replay([record_drive("w", samples=samples)], ReplayOptions()).summary
    assert summary["samples_dropped"] == none | {"late": 1, "same_stamp": 1, "unusable": 1}
    dropped, unusable, no_covariance, _ = summary["warnings"]  # the last: no time_increment
    assert dropped == (
        "/base/odom: 2 of 39 (5.1 %) messages are dropped: 1 with the stamp of the one before, 1 out of order"
    )
    assert unusable.startswith("/base/odom: 1 of 40 messages cannot be used")
    assert no_covariance.startswith("/base/odom: the covariance of 1 of 40 messages is none")
    assert (summary["covariances_ignored"], summary["scans_before_odometry"]) == (1, 0)
    assert "/base/odom: 1 of 40 messages cannot be used" in caplog.text
    assert "/base/odom: the covariance of 1 of 40 messages is none" in caplog.text


def test_recorded_requests_are_fulfilled_where_they_stand(record_drive: RecordDrive):
    """Request k comes before scan k was read; scan k is at k centimetres."""
    done = replay([record_drive(requests={10: "pause", 20: "resume", 30: "reset_map"})], ReplayOptions())
    mapped = [(o.stamp_ns - T0_NS) // 20_000_000 for o in done.outputs]
    assert mapped == [*range(10), *range(20, 40)]
    assert (done.summary["scans"], done.summary["scans_paused"], done.summary["map_resets"]) == (30, 10, 1)
    assert done.summary["scans_dropped"] == 0
    x_m = {k: output.pose_map_base.x_m for k, output in zip(mapped, done.outputs, strict=True)}
    assert x_m[29] == pytest.approx(0.29, abs=0.01)
    assert x_m[30] == pytest.approx(0.0, abs=1e-9)
    assert x_m[39] == pytest.approx(0.09, abs=0.01)
    assert done.outputs[-1].pose_odom_base.x_m == pytest.approx(0.38, abs=0.01)


def test_a_reset_at_the_very_end_leaves_the_map_before_to_be_shown(record_drive: RecordDrive, tmp_path: Path):
    plain = replay([record_drive("a")], ReplayOptions())
    done = replay([record_drive("b", requests={40: "reset_map"})], ReplayOptions())
    assert len(done.outputs) == 40
    assert done.summary["map_tiles"] == plain.summary["map_tiles"] > 0
    write_replay(done, tmp_path / "out")


def test_each_result_has_a_folder_of_its_own():
    a, b, c = Path("a/v_20261121T101500Z_0001.mcap"), Path("b/v_20261121T101500Z_0001.mcap"), Path("c/x.mcap")
    assert result_folders([[a]], Path("o")) == [Path("o")]
    assert result_folders([[c]], None) == [Path("out/replay_x")]
    assert result_folders([[a], [c]], Path("o")) == [Path("o/v_20261121T101500Z"), Path("o/x")]
    assert result_folders([[a], [b], [b]], None) == [
        Path("out/replay_v_20261121T101500Z"),
        Path("out/replay_v_20261121T101500Z_2"),
        Path("out/replay_v_20261121T101500Z_3"),
    ]


def test_the_same_recording_gives_the_same_bytes_alone_and_among_others(
    record_drive: RecordDrive, tmp_path: Path
):
    bad = tmp_path / "bad.mcap"
    bad.write_text("no recording")
    sessions = [[record_drive("a")], [bad], [record_drive("b", scans=30)]]
    facts: list[tuple[float | None, str]] = []
    folders, others = (result_folders(sessions, tmp_path / name) for name in "12")
    one_by_one = replay_all(sessions, ReplayOptions(), folders, lambda *how_far: facts.append(how_far))
    tasks = new_tasks(sessions, ReplayOptions(), others)
    with Processes(2) as processes:
        at_once = [done.outcome for done in run_batch(tasks, processes, lambda *_: None)]
    assert [s["scans"] for s in one_by_one[::2]] == [s["scans"] for s in at_once[::2]] == [40, 30]
    assert "bad.mcap is no recording" in str(at_once[1])
    assert str(at_once[1]) == str(one_by_one[1])
    shares = [share for share, phase in facts if phase == "mapping" and share is not None]
    assert shares == sorted(shares)
    assert shares[-1] == 1.0
    assert facts[-1] == (None, "closing loops")
    written = [path.relative_to(tmp_path / "1") for path in (tmp_path / "1").rglob("*.*") if path.is_file()]
    assert len([path for path in written if len(path.parts) == 2]) == 16  # beside the stored maps
    for path in written:
        if path.name != "summary.json":
            assert (tmp_path / "1" / path).read_bytes() == (tmp_path / "2" / path).read_bytes()


@pytest.mark.parametrize("jobs", ["1", in_soak("2")])
def test_a_session_that_cannot_be_read_keeps_no_other_back(
    jobs: str, record_drive: RecordDrive, tmp_path: Path, capfd: pytest.CaptureFixture[str]
):
    bad, good, old = tmp_path / "bad.mcap", record_drive(), record_drive("old", config="sensors: {}")
    bad.write_text("no recording")
    requested = ["replay", *map(str, (bad, good, old)), "--out", str(tmp_path / "out"), "--jobs", jobs]
    assert main([*requested, "--json"]) == InputError.exit_code
    said = capfd.readouterr()
    facts = json.loads(said.out)
    assert "bad.mcap is no recording" in facts[str(bad)]["error"]
    assert facts[str(good)]["scans"] == 40
    assert (Path(facts[str(good)]["out"]) / "map.png").exists()
    assert "recorded config:1:" in facts[str(old)]["error"]
    assert facts[str(bad)]["error"] in said.err


def test_a_recorded_config_that_cannot_be_read_asks_for_one(record_drive: RecordDrive):
    session = record_drive(config=CONFIG % 0.0 + "radar: {}\n")
    with pytest.raises(ConfigError, match=r"radar: unknown key(.|\n)*--config"):
        replay([session], ReplayOptions())


def test_an_unknown_profile_is_a_config_error(record_drive: RecordDrive):
    with pytest.raises(ConfigError, match="--profile: fast is no profile"):
        replay([record_drive()], ReplayOptions(profile="fast"))


def test_a_folder_that_cannot_be_written_is_a_storage_error(record_drive: RecordDrive, tmp_path: Path):
    (tmp_path / "file").write_text("")
    with pytest.raises(StorageError, match="cannot write to"):
        write_replay(replay([record_drive()], ReplayOptions()), tmp_path / "file")


def test_a_folder_without_recordings_is_bad_input(tmp_path: Path):
    with pytest.raises(InputError, match=r"no recording in this folder"):
        group_sessions([tmp_path])


@pytest.mark.parametrize("fill", [math.nan, math.inf, 0.0, 50.0, None], ids=str)
def test_scans_without_one_beam_that_came_back_are_refused_in_words(
    fill: float | None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """50 m is beyond range_max; None: scans without a beam."""
    messages = [encode_tf_static({"front": SE2()}, T0_NS, T0_NS)]
    for k in range(5):
        scan = room_scan(T0_NS + k * 20_000_000, 0.0)
        ranges = np.zeros(0, np.float32) if fill is None else np.full(BEAMS, fill, np.float32)
        messages.append(encode_frame(replace(scan, range_m=ranges)))
    write_file(tmp_path / "blind.mcap", messages)
    out = tmp_path / "out"
    assert main(["replay", str(tmp_path / "blind.mcap"), "--out", str(out)]) == InputError.exit_code
    last = capsys.readouterr().err.splitlines()[-1]
    expected = "not one scan could be mapped" if fill is None else "0 beams came back in 5 scans of front"
    assert last.startswith(f"corridor: {tmp_path / 'blind.mcap'}: ")
    assert expected in last
    assert not list(out.glob("*"))
