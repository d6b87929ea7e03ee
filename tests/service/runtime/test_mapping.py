"""Frames and commands in, recorded messages, poses and tiles out; the mapper answers in place."""

import json
import math
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pytest

from drivers.frames import LaserScan, OdometrySample
from service.encoding import (
    Message,
    decode_event,
    decode_frame,
    decode_graph,
    decode_grid,
    decode_pose,
    decode_step,
)
from service.mapper.components import EditAnswer
from service.mapper.map_changes import MapChanges
from service.mapper.mapping_session import ApplyResult, LeftOut, MappingSession
from service.outputs import UNKNOWN, GraphPicture, Grid
from service.runtime.mapper_messages import MAX_AGE_NS, Answer
from service.runtime.mapping import MapperError, MappingLoop
from tests.service.runtime.mapping_runs import FRAMES, MS, OFFSET_NS, FakeMapper, GraphAtWork, Run, scan


def test_the_mapper_eats_what_the_recording_holds():
    mapper = FakeMapper()
    run = Run(mapper).put(*FRAMES)
    recorded = [m for m in run.recorded if m.channel in ("front/scan", "base/odom")]
    assert [frame.sensor for frame in mapper.eaten] == ["base", "front", "front"]
    for message, eaten in zip(recorded, mapper.eaten, strict=True):
        again = decode_frame(message.type, message.payload, eaten.sensor, message.log_ns)
        assert (again.stamp_ns, again.arrived_ns) == (eaten.stamp_ns, eaten.arrived_ns)
        if isinstance(again, LaserScan):
            np.testing.assert_array_equal(again.range_m, eaten.range_m)


def test_a_laser_that_is_not_mapped_is_recorded():
    run = Run(FakeMapper()).put(
        scan(10, 20, [1.0]), scan(20, 30, [1.0, 2.0], "rear"), scan(21, 40, [], "rear"), scan(40, 60, [1.1])
    )
    run.link.finish()
    assert [m.channel for m in run.recorded].count("rear/scan") == 2
    assert [m.channel for m in run.recorded].count("pose") == 2
    assert run.outputs.counters["scans_not_mapped"] == 1
    assert run.outputs.scan_cpu.count == 2
    assert (run.outputs.unusable_scans, run.outputs.unusable["rear"]) == (0, 1)


def test_each_scan_gives_pose_odom_and_tf_with_the_moment_it_was_read():
    run = Run(FakeMapper()).put(*FRAMES)
    published = [message.channel for message in run.recorded]
    assert sorted(published) == sorted(["base/odom", *2 * ["front/scan", "pose", "odom", "tf"]])
    assert [arrived for message, arrived in run.put_out if message.channel == "pose"] == [20, 60]
    assert all(arrived is None for message, arrived in run.put_out if message.channel != "pose")
    poses = [decode_pose(message.payload).pose.x_m for message in run.recorded if message.channel == "pose"]
    assert poses == [1.0, 2.0]
    assert run.outputs.states == {"ok": 2}


def test_a_pose_that_is_given_up_is_an_event_once_and_none_when_there_is_news(caplog):
    mapper = FakeMapper()
    run = Run(mapper)
    at = (1.0, 2.0, 0.5)
    for refused, frame in zip((None, at, at, None, at), scans_in_turn(5), strict=True):
        mapper.pose_refused = refused
        run.put(frame)
    events = [json.loads(decode_event(m.payload)) for m in run.recorded if m.channel == "events"]
    facts = {"event": "set_pose_given_up", "x_m": 1.0, "y_m": 2.0, "theta_rad": 0.5}
    assert events == [facts, facts]
    assert "(1.00, 2.00) m, 0.50 rad is rejected" in caplog.text


def scans_in_turn(count: int) -> list[LaserScan]:
    return [scan(10 + 30 * k, 20 + 30 * k, [1.0, 2.0]) for k in range(count)]


class Shown:
    """A mapping loop whose clock a test moves, and what comes of it beside the poses."""

    def __init__(self, *mappers: FakeMapper) -> None:
        fresh, self.sent, self.now_ns = iter(mappers), list[Any](), 10**9
        self.session = MappingSession(lambda: next(fresh), ["front"], None)
        self.loop = MappingLoop(self.session, self.sent.append, (), lambda: self.now_ns)
        self._run = Run(FakeMapper())

    def later(self, channel: str, seconds: float = 1.0, is_idle: bool = True) -> list[Message]:
        """What is new on the channel."""
        self.now_ns += round(seconds * 1e9)
        self.sent.clear()
        self.loop.keep_up(is_idle)
        self._run.put_out.clear()
        for message in self.sent:
            self._run.outputs.heard(message)
        return [message for message in self._run.recorded if message.channel == channel]


def test_the_graph_is_shown_when_it_was_rendered_again_and_taken_away_by_a_reset():
    mapper = FakeMapper()
    shown = Shown(mapper, FakeMapper())
    assert shown.later("graph") == []
    ends = np.ones((3, 2, 2), np.float32)
    mapper.graph_picture = GraphPicture(40, [np.ones((5, 2), np.float32)], ends, ends[:1])
    (message,) = shown.later("graph")
    picture = decode_graph(message.payload)
    assert (message.stamp_ns, len(picture.accepted), len(picture.refused)) == (40, 3, 1)
    assert shown.later("graph") == []
    shown.session.carry_out("reset_map")
    (message,) = shown.later("graph")
    assert not decode_graph(message.payload).paths
    assert shown.later("graph") == []


def test_what_has_changed_is_reported_when_it_is_something_else():
    mapper = FakeMapper()
    shown = Shown(mapper, FakeMapper())

    def facts() -> list[Grid]:
        return [decode_grid(message.payload) for message in shown.later("map/changes")]

    assert facts() == []  # no one watches
    mapper.changes_reported = changed([0.25])
    (grid,) = facts()
    assert (grid.cells.tolist(), grid.x_min_m, grid.cell_m) == ([[100]], pytest.approx(0.2), 0.1)
    mapper.changes_reported = changed([0.25])
    assert facts() == []  # the same cells
    mapper.changes_reported = changed([0.25, 0.35])
    (grid,) = facts()
    assert grid.cells.tolist() == [[100, 100]]
    shown.session.carry_out("reset_map")
    (grid,) = facts()
    assert grid.cells.size == 0


def changed(x_m: list[float]) -> MapChanges:
    stamps = np.zeros(len(x_m), np.int64)
    xy_map = np.array([(x, 0.05) for x in x_m])
    return MapChanges(0.1, xy_map, np.ones(len(x_m), np.bool_), stamps, stamps, stamps)


def test_what_stands_is_reported_each_two_seconds_while_scans_come():
    mapper = FakeMapper()
    mapper.stands = Grid(0, 0.1, 2.0, 3.0, np.full((2, 3), 40, np.int8))
    shown = Shown(mapper)
    items = iter(Run(FakeMapper()).put(*FRAMES).link.items)

    def take(count: int) -> None:
        for _ in range(count):
            shown.loop.take(next(items)._replace(arrived_ns=shown.now_ns))

    assert shown.later("standing", 0.0) == []  # no scan was mapped
    take(2)
    assert shown.later("standing", 1.0) == []
    (message,) = shown.later("standing", 1.1)
    assert decode_grid(message.payload).cells.tolist() == mapper.stands.cells.tolist()
    assert shown.later("standing", 2.1) == []  # nothing came meanwhile
    take(1)
    assert shown.later("standing", 2.1, is_idle=False) == []  # items wait
    assert len(shown.later("standing", 8.0, is_idle=False)) == 1
    mapper.stands = None
    assert shown.later("standing", 9.0) == []


def test_a_frame_without_anything_to_map_is_counted_and_recorded():
    mapper = FakeMapper()
    bad = OdometrySample("base", 1, 2, math.nan, 0.0, 0.0, (0.0, 0.0, 0.0), (0.0,) * 9)
    run = Run(mapper).put(bad)
    assert run.outputs.unusable == {"base": 1}
    assert not mapper.eaten
    assert [m.channel for m in run.recorded] == ["base/odom"]


def test_a_mapper_that_raises_is_reported_with_the_number_of_the_frame():
    run = Run(FakeMapper(fault=ZeroDivisionError("float division"))).put(FRAMES[0])
    with pytest.raises(MapperError, match=r"scan of front stamped 17.*ZeroDivisionError") as raised:
        run.put(FRAMES[1])
    assert raised.value.number == 2
    assert run.recorded[-1].channel == "front/scan"


def test_a_pose_that_is_no_number_is_a_fault():
    with pytest.raises(MapperError, match="gave the pose SE2"):
        Run(FakeMapper(x_m=math.inf)).put(*FRAMES)


def test_a_scan_that_has_waited_too_long_is_passed_over_and_the_recording_says_so():
    mapper = FakeMapper()
    run = Run(mapper).put(scan(10, 20, [1.0, 2.0]))
    run.put(scan(40, 60, [1.0, 2.0]), waits_ns=MAX_AGE_NS + 1)
    run.put(scan(70, 90, [1.0, 2.0]), waits_ns=MAX_AGE_NS)
    assert mapper.skipped == 1
    assert [m.stamp_ns - OFFSET_NS for m in run.recorded if m.channel == "pose"] == [10, 70]
    assert [m.channel for m in run.recorded].count("front/scan") == 3
    (event,) = [m for m in run.recorded if m.channel == "events"]
    assert event.log_ns - OFFSET_NS == 59  # right before its scan
    assert decode_step(event.payload, event.log_ns) == LeftOut("front", "old", event.log_ns)
    assert run.outputs.passed_over == {"front": 1}


def test_an_overload_begins_with_the_third_scan_and_ends_ten_seconds_after_the_last():
    run = Run(FakeMapper())
    for at_ns in (10, 40):
        run.put(scan(at_ns, at_ns + 20, [1.0, 2.0]), waits_ns=MAX_AGE_NS + 1)
    assert run.outputs.overload() == ""
    run.put(scan(200 * MS, 200 * MS + 20, [1.0, 2.0]), waits_ns=MAX_AGE_NS + 1)
    assert run.outputs.overload().startswith("3 scans in 0.2 s were not mapped, having waited up to 50 ms (")
    run.link.now_ns += 9 * 10**9
    assert run.outputs.overload().startswith("3 scans in 9.2 s were not mapped")
    run.link.now_ns += 10**9 + 1
    assert run.outputs.overload() == ""


def test_a_command_is_carried_out_between_the_frames_it_came_between():
    mapper = FakeMapper()
    now_ns = time.monotonic_ns()  # which is the time of a command
    run = Run(mapper).put(scan(now_ns, now_ns, [1.0, 2.0]))
    assert [answer.result for answer in run.request("pause")] == [True]
    run.put(scan(now_ns + 10, now_ns + 10, [1.0, 2.0]))
    assert [answer.result for answer in run.request("resume")] == [True]
    run.put(scan(now_ns + 30, now_ns + 30, [1.0, 2.0]))
    assert run.channels() == ["front/scan", "pose", "events", "front/scan", "events", "front/scan", "pose"]
    events = [decode_event(m.payload) for m in run.recorded if m.channel == "events"]
    assert events == ['{"event": "pause"}', '{"event": "resume"}']
    log_ns = [m.log_ns for m in run.recorded if m.channel in ("front/scan", "events")]
    assert log_ns == sorted(log_ns)
    assert mapper.skipped == 1
    run.link.finish()
    assert run.outputs.counters["scans_paused"] == 1


def test_a_reset_empties_the_map_for_all_and_versions_go_on():
    now_ns = time.monotonic_ns()  # which is the time of a command
    run = Run(FakeMapper()).put(*[scan(now_ns + k, now_ns + k, [1.0, 2.0]) for k in (10, 20)])
    run.request("reset_map")
    (before,) = run.tiles.since(0)
    run.outputs.map_reset()
    (emptied,) = run.tiles.since(0)
    assert (before.version, bool((before.cells == UNKNOWN).all())) == (2, False)
    assert (emptied.version, bool((emptied.cells == UNKNOWN).all())) == (3, True)
    assert run.outputs.last is None
    run.put(scan(now_ns + 30, now_ns + 30, [1.0, 2.0]))
    run.link.finish()
    (after,) = run.tiles.since(0)
    assert (after.version, bool((after.cells == UNKNOWN).all())) == (4, False)
    assert run.handed_over[-2:] == [(3, now_ns + 20), (4, now_ns + 30)]
    poses = [decode_pose(m.payload).pose.x_m for m in run.recorded if m.channel == "pose"]
    assert poses == [1.0, 2.0, 1.0]


def test_after_close_nothing_is_taken():
    run = Run(FakeMapper())
    run.intake.close()
    run.put(scan(10, 10, [1.0]))
    assert not run.recorded
    assert run.intake.mark({"event": "mark"}, lambda event: None) == "the service is stopping"


def test_a_result_of_the_graph_is_applied_between_two_frames_and_the_recording_says_where():
    mapper = FakeMapper(graph=GraphAtWork())
    run = Run(mapper).put(*FRAMES)
    run.link.finish()
    # samples wait for the first scan
    assert [eaten == "apply_result" for eaten in mapper.eaten] == [True, False, False, False]
    (event,) = [m for m in run.recorded if m.channel == "events"]
    assert decode_step(event.payload, event.log_ns) == ApplyResult(event.log_ns)
    assert event.log_ns - OFFSET_NS == 31  # right before the scan, which came after the sample of 30
    assert mapper.finished


def test_the_recording_says_where_the_work_of_the_graph_was_lost():
    run = Run(FakeMapper(graph=GraphAtWork(lost="the process died"))).put(*FRAMES)
    run.link.finish()
    (event,) = [m for m in run.recorded if m.channel == "events"]
    assert json.loads(decode_event(event.payload)) == {"event": "graph_lost", "reason": "the process died"}


class GraphWithEdits(GraphAtWork):
    """Makes every change when it is asked for its result; or ends."""

    def __init__(self, lost: str = "") -> None:
        super().__init__(lost)
        self.ready = False

    def request(self, name: str, payload: Mapping[str, Any]) -> None:
        self.ready = True


class EditedMapper(FakeMapper):
    def __init__(self, graph: GraphWithEdits) -> None:
        super().__init__(graph=graph)
        self.edited: list[EditAnswer] = []

    def apply_result(self) -> None:
        super().apply_result()
        if not self.graph.fault:
            self.edited.append(EditAnswer({"done": "erased"}))


def answers_to_an_edit(graph: GraphWithEdits, then: Callable[[Run], Any]) -> list[Answer]:
    """None before what comes next, and these after it."""
    run, answers = Run(EditedMapper(graph), prepare_map=lambda folder, version: None), []
    run.put(scan(10, 20, [1.0]))
    run.intake.mark(
        {"event": "edit_map"},
        lambda event: run.intake.request_graph("edit_map", {}, event.log_ns, answers.append),
    )
    assert answers == []
    then(run)
    return answers


@pytest.mark.parametrize("waits_ns", [0, MAX_AGE_NS + 1])
def test_a_change_by_hand_is_answered_when_its_result_is_applied_also_where_scans_are_left_out(waits_ns: int):
    next_scan = scan(40, 60, [1.0])
    (answer,) = answers_to_an_edit(GraphWithEdits(), lambda run: run.put(next_scan, waits_ns=waits_ns))
    assert (answer.result, answer.error) == ({"done": "erased"}, "")


def test_a_change_by_hand_fails_with_the_graph_or_the_map(monkeypatch: pytest.MonkeyPatch):
    (answer,) = answers_to_an_edit(GraphWithEdits("killed"), lambda run: run.put(scan(40, 60, [1.0])))
    assert answer.error == "the change is not made: killed"

    def load(run: Run) -> None:
        run.intake.request_map("office", 1, 40, lambda answer: None)

    for start_over in (load, lambda run: run.request("reset_map")):
        slow = GraphWithEdits()
        monkeypatch.setattr(slow, "request", lambda name, payload: None)
        (answer,) = answers_to_an_edit(slow, start_over)
        assert "map has ended before" in answer.error
