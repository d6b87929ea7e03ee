"""Commands from another process to a service that maps, and what a replay makes of them."""

import json
import math
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

from drivers.registry import SENSOR_KINDS
from service.config import parse_config
from service.encoding import (
    decode_diagnostics,
    decode_event,
    decode_frame,
    decode_grid,
    decode_pose,
    encode_frame,
    encode_pose,
)
from service.mapstore.files import load_map
from service.offline.replay.replay import ReplayOptions, replay
from service.outputs import UNKNOWN
from service.recording.mcap_reader import Recording
from service.recording.raw_wire import frames_from_wire, raw_chunks
from tests.system.machine import LiveService, Subscriber

Subscribe = Callable[[str], Subscriber]
FASTEST_MPS = 1.0  # that the fake vehicle drives


def test_a_drive_with_commands(live_service: LiveService, subscribe: Subscribe):
    subscriber = subscribe(live_service.endpoint)
    subscriber.wait_for("pose", 100)  # it stands for a second of them at most

    marked = subscriber.ask("mark", text="begin", id="1")
    assert subscriber.ask("mark", text="begin", id="1") == marked
    assert "did you mean 'text'" in subscriber.ask("mark", txt="begin")["error"]

    assert subscriber.ask("pause")["changed"]
    subscriber.wait_for("front/scan", 25)
    subscriber.wait_until(lambda: _state(subscriber) == "paused")
    assert subscriber.ask("resume")["changed"]
    subscriber.wait_for("pose", 25)

    saved = subscriber.ask("save_map")
    first_map = Path(saved["folder"])
    stored = load_map(first_map)
    newest = max(tile.version for tile in stored.tiles)
    assert (stored.number, newest) == (saved["version"], saved["map_version"])

    reset = subscriber.ask("reset_map")
    assert (reset["folder_before"], reset["folder"]) == (str(first_map), f"{first_map}_2")
    before = load_map(first_map)
    subscriber.wait_for("pose", 75)
    _check_the_old_map_is_gone(subscribe(live_service.endpoint), before.tiles)

    stopped = subscriber.ask("stop_recording")
    subscriber.wait_for("front/scan", 25)
    started = subscriber.ask("start_recording")
    assert stopped["changed"]
    assert started["changed"]
    subscriber.wait_for("pose", 50)
    live_service.signal(signal.SIGTERM)
    assert live_service.wait() == 0, live_service.log

    (first,) = [Path(path) for path in stopped["files"]]
    (second,) = [Path(path.removesuffix(".active")) for path in started["files"]]
    assert sorted(live_service.sessions.iterdir()) == sorted([first, second])
    assert sorted(live_service.maps.iterdir()) == [first_map, Path(f"{first_map}_2")]
    _check_the_commands_stand_in_the_recording(first)
    _check_the_replay_is_the_drive(first)
    _check_the_wires_make_the_frames_again(first)
    _check_a_session_of_its_own(second)


def _state(subscriber: Subscriber) -> str:
    statuses = decode_diagnostics(subscriber.heard["health"][-1][1]) if "health" in subscriber.heard else []
    return next((s.values.get("state", "") for s in statuses if s.name == "mapping"), "")


def _check_the_old_map_is_gone(late: Subscriber, before: list[Any]) -> None:
    """For who joins after the reset: each tile is of the new map, or all unknown, and newer in any case."""
    last_before = max(tile.version for tile in before)
    fetched = late.get("map/tile/**?since=0")
    assert {f"map/tile/{t.level}/{t.ix}/{t.iy}" for t in before} <= fetched.keys()
    assert all(version > last_before for version, _ in fetched.values())
    emptied = last_before + len(before)
    known = {key for key, (_, payload) in fetched.items() if (decode_grid(payload).cells != UNKNOWN).any()}
    assert known == {key for key, (version, _) in fetched.items() if version > emptied}
    assert len(known) > 3


def _check_the_commands_stand_in_the_recording(session: Path) -> None:
    events = [json.loads(decode_event(m.payload)) for m in Recording([session]).messages(["/events"])]
    # Which states it went through is up to the load of the machine; it was paused in any case.
    states = {event["state"] for event in events if event["event"] == "mapping" and event["reason"]}
    assert "paused" in states
    aside = ("start", "sensor", "mapping", "apply_result", "scan_passed_over")
    names = [event["event"] for event in events if event["event"] not in aside]
    saves = ["save_map", "checkpoint", "checkpoint", "reset_map"]  # each with the graph
    assert names == ["mark", "pause", "resume", *saves, "stop_recording"]
    assert {"event": "mark", "id": "1", "text": "begin"} in events


def _check_the_replay_is_the_drive(session: Path) -> None:
    recording = Recording([session])
    recorded = [m.payload for m in recording.messages(["/pose"])]
    replayed = replay([session], ReplayOptions())
    again = [encode_pose(output, 0).payload for output in replayed.outputs]
    assert again[: len(recorded)] == recorded
    assert len(again) - len(recorded) <= 5  # of scans that were being mapped when the recording ended
    assert replayed.summary["map_resets"] == 1
    assert replayed.summary["scans_paused"] == len(_scans_between(recording, "pause", "resume")) > 0
    assert replayed.summary["scans_dropped"] == 0
    _check_odom_goes_on_over_the_reset(recording)


def _scans_between(recording: Recording, begin: str, end: str) -> list[int]:
    """Log times of the scans between two events."""
    events = {json.loads(decode_event(m.payload))["event"]: m.log_ns for m in recording.messages(["/events"])}
    log_times_ns = [m.log_ns for m in recording.messages(["/front/scan"])]
    return [log_ns for log_ns in log_times_ns if events[begin] < log_ns < events[end]]


def _check_odom_goes_on_over_the_reset(recording: Recording) -> None:
    events = recording.messages(["/events"])
    reset_ns = next(m.log_ns for m in events if '"reset_map"' in decode_event(m.payload))
    read_ns = {m.stamp_ns: m.log_ns for m in recording.messages(["/front/scan"])}  # by the stamp of a scan
    for topic, jumps in (("/odom", False), ("/pose", True)):
        poses = [(read_ns[m.stamp_ns], decode_pose(m.payload).pose) for m in recording.messages([topic])]
        before_ns, before = [(log_ns, pose) for log_ns, pose in poses if log_ns < reset_ns][-1]
        after_ns, after = next((log_ns, pose) for log_ns, pose in poses if log_ns > reset_ns)
        driven_m = FASTEST_MPS * (after_ns - before_ns) / 1e9
        assert (math.hypot(after.x_m - before.x_m, after.y_m - before.y_m) > 0.2 + driven_m) is jumps


def _check_the_wires_make_the_frames_again(session: Path) -> None:
    recording = Recording([session])
    config = parse_config(recording.metadata["config"]["yaml"], "recorded config")
    offset_ns = int(recording.metadata["clock"]["utc_offset_ns"])
    for name, channel, least in (("front", "/front/scan", 200), ("base", "/base/odom", 200)):
        sensor = config.sensors[name]
        new_session = SENSOR_KINDS[sensor.type].session_maker(sensor)
        frames = list(frames_from_wire(raw_chunks(recording, name), new_session))
        recorded = list(recording.messages([channel]))
        assert len(frames) >= len(recorded) > least
        for frame, message in zip(frames, recorded, strict=False):
            assert encode_frame(frame, offset_ns, message.log_ns).payload == message.payload


def _check_a_session_of_its_own(session: Path) -> None:
    recording = Recording([session])
    counts = {topic.name: topic.count for topic in recording.topics}
    assert counts["/front/scan"] >= 25  # of 50 poses heard since, some are of scans read before it began
    assert counts["/tf_static"] == 1
    assert "sick_lms100" in recording.metadata["config"]["yaml"]
    first, static = (next(iter(recording.messages(topics))) for topics in (None, ["/tf_static"]))
    # A pose that was on its way when the recording began has an earlier log time.
    assert static.log_ns - first.log_ns < 100_000_000
    replayed = replay([session], ReplayOptions())
    events = [decode_event(m.payload) for m in recording.messages(["/events"])]
    too_old = sum("scan_passed_over" in event for event in events)
    assert len(replayed.outputs) + too_old == counts["/front/scan"]
    assert replayed.outputs[0].pose_map_base.x_m == 0.0  # a map of its own
    first = next(iter(recording.messages(["/front/scan"])))
    assert decode_frame(first.type, first.payload, "front", first.log_ns) is not None
