import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest

from drivers.frames import NO_INTENSITY, Frame, LaserScan, OdometrySample
from service.encoding import Message, decode_control, decode_event, decode_frame, decode_pose
from service.geometry.se2 import SE2
from service.mapper.graph.no_graph import NoGraph
from service.mapper.stages import FinishedGraph, GraphUpdate
from service.mapper.steering import SteeredMapper, TakeIn
from service.mapstore.tiles import TileStore
from service.outputs import UNKNOWN, MapperOutput, TileUpdate
from service.runtime.host_time import HostTime
from service.runtime.mapping import MapperError, MappingLoop
from service.runtime.queues import Command, FrameQueue

OFFSET_NS = 1_700_000_000_000_000_000


class FakeMapper:
    """Puts every scan one metre further along x; notes what it was given."""

    finished = False

    def __init__(
        self, fault: Exception | None = None, x_m: float | None = None, graph: NoGraph | None = None
    ) -> None:
        self.counters: Counter[str] = Counter()
        self.eaten: list[Frame] = []
        self.skipped = 0
        self._mapped = self._changed = 0
        self._fault = fault
        self._x_m = x_m
        self.graph = graph or NoGraph()

    def take_in(self) -> None:
        self.eaten.append("take_in")  # type: ignore[arg-type]
        self.graph.take_in()

    def finish(self) -> FinishedGraph:
        self.finished = True
        return FinishedGraph()

    def process(self, frame: Frame) -> MapperOutput | None:
        self.eaten.append(frame)
        if not isinstance(frame, LaserScan):
            return None
        if self._fault is not None:
            raise self._fault
        self.counters["scans"] += 1
        self._mapped += 1
        self._changed = self._mapped
        x_m = float(self._mapped) if self._x_m is None else self._x_m
        pose = SE2(x_m, 0.0, 0.0)
        return MapperOutput(frame.stamp_ns, pose, SE2(), (0.0, 0.0, 0.0), np.zeros((3, 3)), "ok", "", 1.0)

    def skip(self, scan: LaserScan) -> None:
        self.skipped += 1

    def changed_tiles(self) -> list[TileUpdate]:
        version, self._changed = self._changed, 0
        return [TileUpdate(0, 0, 0, version, 0.05, np.zeros((4, 4), np.int8))] if version else []


def scan(stamp_ns: int, arrived_ns: int, ranges: list[float]) -> LaserScan:
    range_m = np.array(ranges, dtype=np.float32)
    return LaserScan("front", stamp_ns, arrived_ns, 1, 3, 0.0, 0.1, 0.01, 20.0, range_m, NO_INTENSITY)


def sample(stamp_ns: int, arrived_ns: int) -> OdometrySample:
    return OdometrySample("base", stamp_ns, arrived_ns, 0.1, 0.2, 0.3, (0.0, 0.0, 0.0), (0.0,) * 9)


class Run:
    """A mapping loop run over frames to its end, with everything it put out."""

    def __init__(self, mapper: FakeMapper, frames: Sequence[Frame | Command]) -> None:
        self.published: list[tuple[Message, int | None]] = []
        self.recorded: list[Message] = []
        self.handed_over: list[tuple[int, int]] = []
        self.tiles = TileStore()
        queue = FrameQueue()
        for frame in frames:
            if isinstance(frame, Command):
                assert queue.put_command(frame) == ""
            else:
                queue.put(frame)
        fresh = iter([mapper])
        queue.close()
        self.loop = MappingLoop(
            queue,
            SteeredMapper(lambda: next(fresh, None) or FakeMapper(), "front"),
            self.tiles,
            HostTime(OFFSET_NS),
            lambda message, arrived_ns: self.published.append((message, arrived_ns)),
            self.recorded.append,
            self._hand_over,
        )

    def _hand_over(self, tiles: list[TileUpdate], stamp_ns: int) -> None:
        self.handed_over.append((tiles[-1].version, stamp_ns - OFFSET_NS))


FRAMES: list[Frame] = [sample(5, 30), scan(10, 20, [1.0, math.nan, 2.0]), scan(40, 60, [1.1, 1.2, 1.3])]


def test_the_mapper_eats_what_the_recording_holds():
    mapper = FakeMapper()
    run = Run(mapper, FRAMES)
    run.loop.run()
    recorded = [m for m in run.recorded if m.channel in ("front/scan", "base/odom")]
    assert [frame.sensor for frame in mapper.eaten] == ["base", "front", "front"]
    for message, eaten in zip(recorded, mapper.eaten, strict=True):
        again = decode_frame(message.type, message.payload, eaten.sensor, message.log_ns)
        assert again is not None
        assert (again.stamp_ns, again.arrived_ns) == (eaten.stamp_ns, eaten.arrived_ns)
        if isinstance(again, LaserScan):
            assert isinstance(eaten, LaserScan)
            np.testing.assert_array_equal(again.range_m, eaten.range_m)


def test_a_laser_that_is_not_mapped_is_published_and_recorded():
    rear, blind = replace(scan(20, 30, [1.0, 2.0]), sensor="rear"), replace(scan(21, 40, []), sensor="rear")
    run = Run(FakeMapper(), [scan(10, 20, [1.0]), rear, blind, scan(40, 60, [1.1])])
    run.loop.run()
    assert [m.channel for m in run.recorded].count("rear/scan") == 2
    assert [m.channel for m, _ in run.published].count("rear/scan") == 2
    assert [m.channel for m in run.recorded].count("pose") == 2
    assert run.loop.counters["scans_not_mapped"] == 1
    assert run.loop.scan_cpu.count == 2
    assert (run.loop.unusable_scans, run.loop.unusable["rear"]) == (0, 1)


def test_log_times_keep_the_order_in_which_the_mapper_ate():
    run = Run(FakeMapper(), FRAMES)  # the scan was read at 20, before the sample at 30, yet queued after it
    run.loop.run()
    log_ns = [m.log_ns - OFFSET_NS for m in run.recorded if m.channel in ("front/scan", "base/odom")]
    assert log_ns == [30, 31, 60]


def test_stamps_are_unix_time_by_the_fixed_offset():
    run = Run(FakeMapper(), FRAMES)
    run.loop.run()
    assert [m.stamp_ns - OFFSET_NS for m in run.recorded if m.channel == "pose"] == [10, 40]


def test_each_scan_gives_pose_odom_and_tf_with_the_moment_it_was_read():
    run = Run(FakeMapper(), FRAMES)
    run.loop.run()
    assert [message.channel for message, _ in run.published] == [
        "base/odom", "front/scan", "pose", "odom", "tf", "front/scan", "pose", "odom", "tf",
    ]  # fmt: skip
    assert [arrived for message, arrived in run.published if message.channel == "pose"] == [20, 60]
    assert all(arrived is None for message, arrived in run.published if message.channel != "pose")
    poses = [decode_pose(message.payload).pose.x_m for message in run.recorded if message.channel == "pose"]
    assert poses == [1.0, 2.0]
    assert run.loop.states == {"ok": 2}


def test_the_last_tiles_are_there_when_the_loop_ends():
    run = Run(FakeMapper(), FRAMES)
    run.loop.run()
    assert run.tiles.version == 2
    assert run.handed_over[-1] == (2, 40)


def test_a_frame_without_anything_to_map_is_counted_and_recorded():
    mapper = FakeMapper()
    bad = OdometrySample("base", 1, 2, math.nan, 0.0, 0.0, (0.0, 0.0, 0.0), (0.0,) * 9)
    run = Run(mapper, [bad])
    run.loop.run()
    assert run.loop.unusable == {"base": 1}
    assert not mapper.eaten
    assert [m.channel for m in run.recorded] == ["base/odom"]


def test_a_mapper_that_raises_ends_the_loop_after_its_frame_was_recorded():
    run = Run(FakeMapper(fault=ZeroDivisionError("float division")), FRAMES)
    with pytest.raises(MapperError, match=r"scan of front stamped 17.*ZeroDivisionError"):
        run.loop.run()
    assert run.recorded[-1].channel == "front/scan"


def test_a_pose_that_is_no_number_ends_the_loop():
    run = Run(FakeMapper(x_m=math.inf), FRAMES)
    with pytest.raises(MapperError, match="gave the pose SE2"):
        run.loop.run()


class Steered:
    """A loop over scans with commands in between; a command's action gets the loop and its event."""

    def __init__(self) -> None:
        self.mapper = FakeMapper()
        self.events: list[Message] = []
        self.queued: list[Frame | Command] = []

    def scan(self, at_ns: int) -> "Steered":
        self.queued.append(scan(at_ns, at_ns, [1.0, 2.0, 3.0]))
        return self

    def command(self, at_ns: int, name: str, action: Callable[[Run], object]) -> "Steered":
        def carry_out(event: Message) -> None:
            self.events.append(event)
            self.run.recorded.append(event)
            action(self.run)

        self.queued.append(Command(at_ns, {"event": name}, carry_out))
        return self

    def go(self) -> Run:
        self.run = Run(self.mapper, self.queued)
        self.run.loop.run()
        return self.run


def test_a_command_is_carried_out_between_the_frames_it_came_between():
    steered = Steered().scan(10).command(8, "pause", lambda run: run.loop.steer("pause")).scan(20)
    run = steered.command(30, "resume", lambda run: run.loop.steer("resume")).scan(40).go()
    assert [m.channel for m in run.recorded if m.channel not in ("odom", "tf")] == [
        "front/scan", "pose", "events", "front/scan", "events", "front/scan", "pose",
    ]  # fmt: skip
    assert [decode_event(e.payload) for e in steered.events] == ['{"event": "pause"}', '{"event": "resume"}']
    log_ns = [m.log_ns - OFFSET_NS for m in run.recorded if m.channel in ("front/scan", "events")]
    assert log_ns == [
        10,
        11,
        20,
        30,
        40,
    ]  # the pause was asked for at 8, but the scan of 10 was mapped already
    assert steered.mapper.skipped == 1
    assert run.loop.counters["scans_paused"] == 1


def test_a_reset_empties_the_map_for_all_and_versions_go_on():
    seen: list[tuple[int, bool]] = []

    def look(run: Run) -> None:
        run.loop.hand_over_tiles()
        (held,) = run.tiles.since(0)
        seen.append((held.version, bool((held.cells == UNKNOWN).all())))

    steered = Steered().scan(10).scan(20)
    steered.command(21, "reset_map", lambda run: (look(run), run.loop.steer("reset_map"), look(run)))
    run = steered.scan(30).command(31, "mark", look).go()
    assert seen == [(2, False), (3, True), (4, False)]
    assert run.handed_over == [(1, 10), (2, 20), (3, 20), (4, 30)]
    assert [m.tiles[0].version for m in run.tiles.take()[0]] == [2]
    poses = [decode_pose(m.payload).pose.x_m for m in run.recorded if m.channel == "pose"]
    assert poses == [1.0, 2.0, 1.0]


def test_after_a_reset_there_is_no_pose_until_the_next_scan():
    outputs = []
    steered = Steered().scan(10).command(11, "reset_map", lambda run: run.loop.steer("reset_map"))
    steered.command(12, "mark", lambda run: outputs.append(run.loop.last_output)).scan(20).go()
    assert outputs == [None]
    assert steered.run.loop.last_output is not None


def test_the_heart_beats_without_frames():
    queue = FrameQueue()
    loop = MappingLoop(
        queue, SteeredMapper(FakeMapper, "front"), TileStore(), HostTime(0), print, print, print
    )
    calls = 0

    def get(timeout_s: float) -> None:
        nonlocal calls
        calls += 1
        if calls == 3:
            queue.close()

    queue.get = get  # type: ignore[method-assign]  # an idle wait that takes no time
    loop.run()
    assert loop.heartbeat == 3


class GraphAtWork(NoGraph):
    """Has one piece of work ready, or lost."""

    def __init__(self, lost: str = "") -> None:
        self.ready = True
        self._lost = lost

    def take_in(self) -> GraphUpdate:
        self.ready, self.trouble = False, self._lost
        return GraphUpdate({})


def test_finished_work_is_taken_in_between_two_frames_and_the_recording_says_where():
    mapper = FakeMapper(graph=GraphAtWork())
    run = Run(mapper, FRAMES)
    run.loop.run()
    assert mapper.eaten[0] == "take_in"
    first = run.recorded[0]
    assert decode_control(first.payload, first.log_ns) == TakeIn(first.log_ns)
    assert first.log_ns < run.recorded[1].log_ns
    assert [m.channel for m in run.recorded].count("events") == 1
    assert mapper.finished


def test_lost_work_is_not_recorded_as_taken_in():
    run = Run(FakeMapper(graph=GraphAtWork("the process died")), FRAMES)
    run.loop.run()
    (event,) = [m for m in run.recorded if m.channel == "events"]
    assert decode_control(event.payload, event.log_ns) is None
    assert "the process died" in decode_event(event.payload)
    assert run.loop.graph_trouble == "the process died"
