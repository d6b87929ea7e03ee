import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from service.cli import main
from service.encoding import encode_frame, encode_tf_static
from service.errors import ConfigError, InputError, StorageError, UsageError
from service.geometry.se2 import SE2
from service.offline.replay.replay import (
    ReplayOptions,
    group_sessions,
    replay,
    result_folders,
    session_name,
    write_replay,
)
from service.offline.replay.result import RESULT_SESSION
from service.offline.score.trajectory import read_tum
from tests.service.offline.recorded_drives import BEAMS, CONFIG, T0_NS, RecordDrive, odometry_at, room_scan
from tests.service.recording.sessions import write_file
from tests.soaked import in_soak

TWO_LASERS = CONFIG.replace("}}}", "}}, rear: {type: hokuyo_utm30lx, host: b, mounting: {x_m: %s}}}") % (0, 0)
SCANS = 40


@pytest.mark.parametrize(
    ("config", "mapped", "others"),
    [
        (TWO_LASERS, 70, 0),
        (TWO_LASERS.replace("host: b", "host: b, map: false"), 40, 30),
        (TWO_LASERS.replace("host: a", "host: a, map: false"), 30, 40),
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


def test_a_config_that_does_not_know_the_lasers_maps_the_fullest(record_drive: RecordDrive, tmp_path: Path):
    """As it is for a recording of another system, and not so where the config names one."""
    session = record_drive(config=None, rear_scans=30)
    config = tmp_path / "c.yaml"
    config.write_text((CONFIG % 0.0).replace("front", "other"))
    assert replay([session], ReplayOptions(config=config)).summary["scans"] == 40
    config.write_text((CONFIG % 0.0).replace("front", "rear"))
    assert replay([session], ReplayOptions(config=config)).summary["scans"] == 30
    config.write_text((CONFIG % 0.0).replace("front: {", "front: {map: false, "))
    with pytest.raises(InputError, match="maps no laser, but the scans here are of front and rear"):
        replay([session], ReplayOptions(config=config))


def test_a_replay_writes_what_other_programs_read_and_counts_what_happened(
    record_drive: RecordDrive, tmp_path: Path
):
    done, out = replay([record_drive(late=True)], ReplayOptions()), tmp_path / "out"
    write_replay(done, out)
    assert {path.name for path in out.iterdir()} == {
        *("trajectory.tum", "trajectory_live.tum", "states.csv", "graph.g2o", "summary.json"),
        *("map.pgm", "map.yaml", "map.png", "map"),
    }
    trajectory = read_tum(out / "trajectory.tum")
    assert trajectory.stamp_ns.tolist() == [T0_NS + k * 20_000_000 for k in range(40)]
    np.testing.assert_allclose(trajectory.pose[:, 0], 0.01 * np.arange(40), atol=0.01)
    np.testing.assert_allclose(trajectory.pose[:, 1], 0.0, atol=0.01)
    summary = json.loads((out / "summary.json").read_text())
    assert summary == done.summary
    assert (summary["scans"], summary["scans_dropped"]) == (40, 1)
    assert summary["duration_s"] == pytest.approx(39 * 0.02)
    assert 0.0 < summary["scan_cpu_ms"]["p50"] <= summary["scan_ms"]["p50"] <= summary["scan_ms"]["max"]
    assert summary["stage_ms_p50"].keys() == {"deskew", "match", "insert"}
    assert sum(summary["state"].values()) == 40
    assert summary["map_tiles"] > 0
    assert summary["keyframes"] == done.g2o.count("VERTEX_SE2") == 2  # one each 0.3 m
    assert 50 < summary["peak_rss_mb"] < 2000


def test_a_full_disk_leaves_the_result_before_and_no_new_folder(
    record_drive: RecordDrive, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    def no_room(*arguments: object) -> None:
        raise OSError(28, "No space left on device")

    done, out = replay([record_drive()], ReplayOptions()), tmp_path / "out"
    write_replay(done, out)
    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    monkeypatch.setattr("service.offline.replay.result.save_map", no_room)
    for folder in (out, tmp_path / "new"):
        with pytest.raises(StorageError, match=f"cannot write to {folder}: No space left on device"):
            write_replay(done, folder)
    assert {path: path.read_bytes() for path in out.rglob("*") if path.is_file()} == before
    assert not (tmp_path / "new").exists()


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


def test_a_map_that_was_edited_or_is_begun_in_is_not_replaced(
    record_drive: RecordDrive, tmp_path: Path, capfd: pytest.CaptureFixture[str]
):
    session = record_drive(scans=150)
    out = tmp_path / "o" / session_name([session])
    stored, command = str(out / "map"), ["replay", str(session)]
    batch = [*command, "--out", str(out.parent), "--jobs", "1"]

    def files() -> dict[str, bytes]:
        return {str(path): path.read_bytes() for path in sorted(out.rglob("*")) if path.is_file()}

    assert main(batch) == 0
    before = files()
    for more in ([], ["--localize"]):
        assert main([*command, "--map", stored, "--out", str(out), *more]) == UsageError.exit_code
        assert f"--map {stored} is read and would be replaced" in capfd.readouterr().err
    assert files() == before
    assert main(["map", "edit", stored, "--wall", "1.0", "-0.5", "1.0", "0.5"]) == 0
    before = files()
    assert main([*command, "--out", str(out)]) == UsageError.exit_code
    assert f"its map was edited (corridor map log {stored})" in capfd.readouterr().err
    assert main([*batch, "--profile", "contour_lm"]) == UsageError.exit_code
    assert main(batch) == 0  # it is done already
    assert files() == before


def test_each_result_has_a_folder_of_its_own():
    a, b, c = Path("a/v_20261121T101500Z_0001.mcap"), Path("b/v_20261121T101500Z_0001.mcap"), Path("c/x.mcap")
    assert result_folders([[a]], Path("o")) == [Path("o")]
    assert result_folders([[a]], Path("o"), is_batch=True) == [Path("o/v_20261121T101500Z")]
    assert result_folders([[c]], None) == [Path("out/replay_x")]
    assert result_folders([[a], [c]], Path("o")) == [Path("o/v_20261121T101500Z"), Path("o/x")]
    assert result_folders([[a], [b], [b]], None) == [
        Path("out/replay_v_20261121T101500Z"),
        Path("out/replay_v_20261121T101500Z_2"),
        Path("out/replay_v_20261121T101500Z_3"),
    ]


@pytest.mark.parametrize("jobs", ["1", in_soak("2")])
def test_a_session_that_cannot_be_read_keeps_no_other_back(
    jobs: str, record_drive: RecordDrive, tmp_path: Path, capfd: pytest.CaptureFixture[str]
):
    bad, good, old = tmp_path / "bad.mcap", record_drive(), record_drive("old", config="sensors: {}")
    bad.write_text("no recording")
    requested = ["replay", *map(str, (bad, good, old)), "--out", str(tmp_path / "out"), "--jobs", jobs]
    assert main([*requested, "--json"]) == InputError.exit_code
    printed = capfd.readouterr()
    facts = json.loads(printed.out)
    assert "bad.mcap is no recording" in facts[str(bad)]["error"]
    assert facts[str(good)]["scans"] == 40
    assert (Path(facts[str(good)]["out"]) / "map.png").exists()
    assert "recorded config:1:" in facts[str(old)]["error"]
    assert facts[str(bad)]["error"] in printed.err


def test_a_config_or_a_profile_that_cannot_be_used_is_a_config_error(record_drive: RecordDrive):
    with pytest.raises(ConfigError, match=r"radar: unknown key(.|\n)*--config"):
        replay([record_drive(config=CONFIG % 0.0 + "radar: {}\n")], ReplayOptions())
    with pytest.raises(ConfigError, match="recorded config: larger than 1000000 bytes"):
        replay([record_drive("v", config=CONFIG % 0.0 + "#" * 1_000_000)], ReplayOptions())
    with pytest.raises(ConfigError, match="--profile: fast is no profile"):
        replay([record_drive("w")], ReplayOptions(profile="fast"))


def test_a_folder_without_recordings_is_bad_input(tmp_path: Path):
    with pytest.raises(InputError, match=r"no recording in this folder"):
        group_sessions([tmp_path])


@pytest.mark.parametrize("fill", [math.nan, 50.0, None], ids=str)
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


def test_another_reader_of_ros_2_messages_finds_poses_map_states_and_loops(
    record_drive: RecordDrive, tmp_path
):
    done = replay([record_drive(scans=SCANS)], ReplayOptions())
    done.poses_map_base = [
        pose.inverse() for pose in done.poses_map_base
    ]  # as the last optimisation left them
    write_replay(done, tmp_path / "out", ["mcap"])
    with AnyReader([tmp_path / "out" / RESULT_SESSION]) as reader:
        messages = [
            (connection.topic, reader.deserialize(raw, connection.msgtype))
            for connection, _, raw in reader.messages()
        ]
    topics = [topic for topic, _ in messages]
    assert topics[:3] == ["/tf_static", "/map", "/graph"]
    for topic in ("/odom", "/tf", "/diagnostics"):
        assert topics.count(topic) == SCANS
    positions = [message.pose.pose.position for topic, message in messages if topic == "/pose"]
    expected = [pose.x_m for pose in done.poses_map_base]
    assert [place.x for place in positions] == pytest.approx(expected, abs=1e-12)
