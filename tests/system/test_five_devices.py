"""All five kinds of device at once, end to end, as in `corridor demo`.

On a machine with little time to spare a fake device leaves turns out, and the queue drops scans. Both are
counted, and no more than that may be missing. Where the machine is in time, streams are without a hole.
"""

import json
import os
import re
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from drivers.frames import Frame
from service.encoding import decode_diagnostics, decode_frame, encode_pose
from service.offline.replay.replay import ReplayOptions, replay
from service.recording.mcap_reader import Recording
from service.resources import CONFIG
from simulators.sick_setup import Lms100Setup
from tests.demo_run import LOOK_S, DemoRun, run_demo

RATES_HZ = {
    "front": 50.0 * Lms100Setup().motor_speed,  # its motor does not turn with 50 Hz quite
    "rear": 40.0,
    "lux": 25.0,
    "imu": 200.0,
    "base": 1000.0 / 15.0,
}
CHANNELS = {"front": "scan", "rear": "scan", "lux": "scan", "imu": "imu", "base": "odom"}
COUNTED_AS_LOST = ("missed", "lost", "gap", "dropped", "discarded", "bad", "unreadable", "resync")
MEASURED = ("scans", "samples", "frames")  # as counters call it
NUMBERED = ("front", "rear", "lux", "imu")  # on the wire; losses of a base are estimated from arrivals
LOST_M = 5.0  # or more, where the map is wrong
SOAK_S = int(os.environ.get("CORRIDOR_SOAK_S", "3600"))
WINDOWS, SETTLED = 12, 2  # that the hour is divided into; the first ones are the map's, whose laps are new
GROWTH = 1.03  # at most, over the first settled window


def test_the_demo_maps_to_a_centimetre(demo_run: DemoRun):
    summary = demo_run.summary
    assert summary.keys() == {
        "seconds", "scans", "scans_dropped", "position_rmse_m", "heading_rmse_deg",
        "latency_ms", "scan_cpu_ms", "rates_hz", "cpu_percent", "void", "session", "map", "failure",
    }  # fmt: skip
    assert not summary["failure"]
    assert summary["seconds"] >= demo_run.seconds
    assert summary["position_rmse_m"] < (0.03 if demo_run.was_in_time else LOST_M)
    assert summary["heading_rmse_deg"] < (0.3 if demo_run.was_in_time else 180.0)
    latency_ms = summary["latency_ms"]
    assert 0.0 < latency_ms["p50"] <= latency_ms["p95"] <= latency_ms["p99"] <= latency_ms["max"]
    assert 0.0 < summary["scan_cpu_ms"]["p50"] < 20.0  # of the processor: waiting for it does not count
    assert Path(summary["session"]).suffix == ".mcap"
    assert (Path(summary["map"]) / "map.yaml").read_text().startswith("image: map.pgm")


def test_what_five_devices_send_is_recorded_and_maps_alike_again(demo_run: DemoRun):
    summary = demo_run.summary
    sessions = _check_that_nothing_is_lost(demo_run)
    replayed = replay(sessions, ReplayOptions())
    recorded = [message.payload for message in Recording(sessions).messages(["/pose"])]
    assert [encode_pose(output, 0).payload for output in replayed.outputs] == recorded
    assert len(recorded) == summary["scans"]
    assert replayed.summary["scans_not_mapped"] == 0


def test_another_reader_finds_what_the_layout_for_foxglove_shows_in_the_recording(demo_run: DemoRun):
    """Topics, fields, frames and lines, decoded by rosbags with the definitions of the file alone."""
    panels = json.loads((CONFIG / "layouts" / "foxglove.json").read_text())["configById"]
    view = panels["3D!corridor-map"]
    fields = [series["value"] for series in panels["Plot!corridor-speed"]["paths"]]
    fields.append(panels["RawMessages!corridor-events"]["topicPath"])
    health = panels["DiagnosticSummary!corridor-health"]["topicToRender"]
    wanted = {*view["topics"], "/tf", "/tf_static", health, *(field.partition(".")[0] for field in fields)}
    types, kinds, last = get_typestore(Stores.EMPTY), {}, {}
    frames, lines = set(), set()
    for path in Path(demo_run.summary["session"]).parent.glob("*.mcap"):
        with path.open("rb") as file:
            for schema, channel, message in make_reader(file).iter_messages(topics=wanted):
                if schema.name not in types.fielddefs:
                    types.register(get_types_from_msg(schema.data.decode(), schema.name))
                kinds[channel.topic] = schema.name
                last[channel.topic] = content = types.deserialize_cdr(message.data, schema.name)
                if channel.topic in ("/tf", "/tf_static"):
                    frames |= {edge.header.frame_id for edge in content.transforms}
                    frames |= {edge.child_frame_id for edge in content.transforms}
                if channel.topic == "/graph":
                    lines |= {marker.ns for marker in content.markers} - {""}
    assert last.keys() == wanted
    for field in fields:
        topic, *names = field.split(".")
        assert isinstance(reduce(getattr, names, last[topic]), float | str), field
    own = {"/map": "OccupancyGrid", "/graph": "MarkerArray", "/pose": "Odometry"}
    shown = {topic: kinds[topic].rpartition("/")[2] for topic in view["topics"]}
    assert shown == {topic: own.get(topic, "LaserScan") for topic in view["topics"]}
    assert {f"/{name}/scan" for name in ("front", "rear", "lux")} <= view["topics"].keys()
    named = {frame.removeprefix("frame:") for frame in view["transforms"]}
    assert named | {view["followTf"], view["fixedFrame"]} <= frames
    assert lines
    assert lines <= view["topics"]["/graph"]["namespaces"].keys()


@pytest.mark.soak
@pytest.mark.timeout(SOAK_S + 300)
def test_an_hour_of_five_devices_loses_nothing_and_no_process_takes_more_memory(tmp_path: Path):

    looks: list[dict[str, float]] = []
    try:
        run = run_demo(SOAK_S, tmp_path, lambda process: looks.append(_resident_mb(process)))
    finally:  # a machine that is too busy may end it with a fault; its memory is known all the same
        rows = _by_windows(looks)
        print(
            f"resident MB, medians of {WINDOWS} windows of {SOAK_S / WINDOWS:.0f} s:", *rows.items(), sep="\n"
        )
    assert len(looks) > 0.8 * SOAK_S / LOOK_S
    assert len(rows) > 3, "the service, the mapper and its stand-by, the back end of each"
    for name, resident_mb in rows.items():
        settled = resident_mb[SETTLED:] or resident_mb[-1:]
        assert max(settled) < GROWTH * settled[0], f"{name}: {resident_mb} MB"
    _check_that_nothing_is_lost(run)


def _by_windows(looks: list[dict[str, float]]) -> dict[str, list[float]]:
    """Of each process that is there in the middle of the last window, the median of each window in which it
    is there: a stand-by may have taken over.

    The last looks are those at the end of the demo, when the mapper has ended.
    """
    parts = [part for part in np.array_split(np.arange(len(looks)), WINDOWS) if len(part)]
    rows = {}
    for name in looks[int(np.median(parts[-1]))] if parts else ():
        there = [[looks[k][name] for k in part if name in looks[k]] for part in parts]
        rows[name] = [round(float(np.median(resident_mb)), 1) for resident_mb in there if resident_mb]
    return rows


def _resident_mb(process: int) -> dict[str, float]:
    """Of the process and of those below it but the fake devices, by what they run; not of one that has just
    ended.
    """
    resident_mb = {}
    waiting = [process]
    while waiting:
        folder = Path(f"/proc/{(process := waiting.pop())}")
        try:
            runs = (folder / "cmdline").read_text().split("\0")
            status = (folder / "status").read_text(encoding="ascii")
            children = "".join((task / "children").read_text() for task in (folder / "task").iterdir())
        except OSError:
            continue
        if "simulators" in runs:
            continue
        waiting += map(int, children.split())
        if found := re.search(r"^VmRSS:\s+(\d+)", status, re.MULTILINE):
            words = next((word for word in runs if "service." in word), "service")
            resident_mb[f"{words} {process}"] = int(found[1]) / 1024
    return resident_mb


def _check_that_nothing_is_lost(run: DemoRun) -> list[Path]:
    """Each stream is recorded whole but for what was left out and counted. The session's files."""
    sessions = sorted(Path(run.summary["session"]).parent.glob("*.mcap"))
    recording = Recording(sessions)
    counts = {topic.name: topic.count for topic in recording.topics}
    facts = [
        {status.name: status.values for status in decode_diagnostics(message.payload)}
        for message in recording.messages(["/diagnostics"])
    ]
    losses, too_old = _losses(facts[-1]), 0
    for name, kind in CHANNELS.items():
        status = facts[-1][f"sensor/{name}"]
        frames, delayed = int(status["frames"]), int(status.get("count.frames_before_clock", "0"))
        received, discarded = _received(status)
        assert received - discarded <= frames <= received
        assert counts[f"/{name}/{kind}"] == frames - delayed > RATES_HZ[name]
        too_old += int(status["dropped"])  # recorded, and not mapped
        lost = losses.pop(name, 0)
        if name in NUMBERED or run.was_in_time:
            assert lost <= run.left_out[name], f"{name}: {lost} missed, {run.left_out[name]} not sent"
        if run.was_in_time:
            messages = recording.messages([f"/{name}/{kind}"])
            streamed = [decode_frame(m.type, m.payload, name, m.log_ns) for m in messages]
            _check_times([frame for frame in streamed if frame is not None], RATES_HZ[name])
    unmapped = {k: int(count) for k, count in facts[-1]["mapping"].items() if k.startswith("scans_dropped_")}
    late = sum(unmapped.values())  # recorded, but too far from their neighbours to be mapped
    assert losses.pop("mapping", 0) == late
    assert late == 0 or too_old > 0 or not run.was_in_time
    assert losses == {}
    assert run.summary["scans_dropped"] == too_old + late
    scans = sum(counts[f"/{name}/scan"] for name in ("front", "rear", "lux"))
    assert scans - late - too_old == counts["/pose"] == run.summary["scans"]
    return sessions


def _received(status: dict[str, str]) -> tuple[int, int]:
    """Measurements that a driver read whole, and those of them that it says it did not hand on."""
    counts = {
        name.removeprefix("count."): int(count)
        for name, count in status.items()
        if name.startswith(tuple(f"count.{what}_" for what in MEASURED))
    }
    received = sum(counts.pop(f"{what}_received", 0) for what in MEASURED)
    return received, sum(count for name, count in counts.items() if not name.endswith("_missed"))


def _check_times(frames: list[Frame], rate_hz: float) -> None:
    """They come at that rate and without a hole."""
    stamps_ns = np.array([frame.stamp_ns for frame in frames])
    between_s = np.diff(stamps_ns) / 1e9
    assert np.diff(stamps_ns).min() > 0
    assert np.median(between_s) == pytest.approx(1.0 / rate_hz, rel=0.01)
    assert between_s.max() < 1.5 / rate_hz, f"{frames[0].sensor}: a hole of {between_s.max()} s"


def _losses(facts: dict[str, dict[str, Any]]) -> dict[str, int]:
    """What the parts counted as lost, by sensor or part; without scans too old to be mapped and messages
    dropped for subscribers, of which there are none.
    """
    losses: dict[str, int] = {}
    for part, values in facts.items():
        for name, value in values.items():
            aside = part == "zenoh" or name == "dropped" or (part, name) == ("mapping", "scans_dropped")
            aside |= name == "count.messages_missed"  # of the IMU, which counts the samples in them as well
            if not aside and value != "0" and any(word in name for word in COUNTED_AS_LOST):
                who = part.removeprefix("sensor/")
                losses[who] = losses.get(who, 0) + int(value)
    return losses
