from collections import Counter
from collections.abc import Callable

import numpy as np
import pytest

from drivers.frames import NO_INTENSITY, Frame, LaserScan, OdometrySample
from service.geometry.se2 import SE2
from service.mapper.components import Correction, FinishedGraph
from service.mapper.mapping_session import MappingSession
from service.mapper.methods.shared import NoGraph
from service.mapper.profiles import build_mapper, mapping_config
from service.outputs import NO_REASON, MapperOutput, TileUpdate
from tests.service.offline.recorded_drives import room_scan


class FakeGraph(NoGraph):
    """Submits the jobs that a test sets."""

    def __init__(self) -> None:
        self.applied_at: list[int] = []
        self.closed = False

    def finish(self) -> FinishedGraph:
        return FinishedGraph([Correction(7, SE2(1.0, 0.0, 0.0), SE2(1.0, 0.1, 0.0))])

    def close(self) -> None:
        self.closed = True


class FakeMapper:
    """Puts every scan a metre ahead of the last; notes what it was given."""

    saved = None
    graph_picture = None
    pose_refused = None

    def standing(self) -> None:
        """Nothing is counted."""

    def __init__(self) -> None:
        self.counters: Counter[str] = Counter()
        self.processed: list[Frame] = []
        self.skipped: list[Frame] = []
        self.graph = FakeGraph()

    def apply_result(self) -> None:
        self.graph.waiting -= 1
        self.graph.applied_at.append(self.counters["scans"])

    def finish(self) -> FinishedGraph:
        return self.graph.finish()

    def process(self, frame: Frame) -> MapperOutput | None:
        self.processed.append(frame)
        if not isinstance(frame, LaserScan):
            return None
        self.counters["scans"] += 1
        pose = SE2(float(sum(isinstance(f, LaserScan) for f in self.processed)) - 1.0, 0.0, 0.0)
        return MapperOutput(
            frame.stamp_ns, pose, SE2(), (0.0, 0.0, 0.0), np.zeros((3, 3)), "ok", NO_REASON, 1.0
        )

    def skip(self, scan: LaserScan) -> None:
        self.skipped.append(scan)

    def changed_tiles(self, most: int | None = None) -> list[TileUpdate]:
        return []


@pytest.fixture
def made() -> list[FakeMapper]:
    return []


@pytest.fixture
def mapper(made: list[FakeMapper]) -> MappingSession:
    def new() -> FakeMapper:
        made.append(FakeMapper())
        return made[-1]

    return MappingSession(new, ["front"])


def scan(stamp_ns: int) -> LaserScan:
    return LaserScan(
        "front", stamp_ns, stamp_ns, 1, 3, 0.0, 0.1, 0.01, 20.0, np.ones(3, np.float32), NO_INTENSITY
    )


def sample(stamp_ns: int, x_m: float = 0.0) -> OdometrySample:
    return OdometrySample("base", stamp_ns, stamp_ns, x_m, 0.0, 0.0, (0.0, 0.0, 0.0), (0.0,) * 9)


def test_in_a_pause_samples_go_on_and_scans_are_let_pass(mapper: MappingSession, made: list[FakeMapper]):
    first, in_pause, moved, later = scan(1), scan(2), sample(3), scan(4)
    assert mapper.process(first) is not None
    assert mapper.carry_out("pause")
    assert mapper.process(in_pause) is None
    assert mapper.process(moved) is None
    assert mapper.carry_out("resume")
    assert mapper.process(later) is not None
    assert made[0].processed == [first, moved, later]
    assert made[0].skipped == [in_pause]
    assert mapper.counters == {"scans": 2, "scans_paused": 1}


def test_a_reset_gives_a_fresh_mapper_counters_go_on_and_a_pause_lasts(
    mapper: MappingSession, made: list[FakeMapper]
):
    mapper.process(scan(1))
    mapper.carry_out("pause")
    assert mapper.carry_out("reset_map")
    assert mapper.paused
    mapper.carry_out("resume")
    mapper.process(scan(2))
    assert [len(m.processed) for m in made] == [1, 1]
    assert mapper.counters == {"scans": 2, "map_resets": 1}


def test_after_a_reset_the_map_begins_at_the_base_while_odom_goes_on(mapper: MappingSession):
    before = [mapper.process(scan(k)) for k in range(1, 4)]
    mapper.carry_out("reset_map")
    after = [mapper.process(scan(k)) for k in range(4, 6)]
    assert [o.pose_odom_base.x_m for o in [*before, *after] if o] == [0.0, 1.0, 2.0, 2.0, 3.0]
    assert [o.pose_map_base.x_m for o in [*before, *after] if o] == [0.0, 1.0, 2.0, 0.0, 1.0]
    mapper.carry_out("reset_map")
    mapper.carry_out("reset_map")
    again = mapper.process(scan(6))
    assert again is not None
    assert (again.pose_odom_base.x_m, again.pose_map_base.x_m) == (3.0, 0.0)


def drive(
    mapper: MappingSession, steps: range, x_m: Callable[[float], float], wheels: bool = True
) -> list[MapperOutput]:
    """Scans of the room each 20 ms of the steps, seen from x_m of the time in s, with wheels in between."""
    outputs = []
    for k in steps:
        stamp_ns = (k + 1) * 20_000_000
        if wheels:
            mapper.process(sample(stamp_ns - 1_000_000, x_m((stamp_ns - 1_000_000) / 1e9)))
        if output := mapper.process(room_scan(stamp_ns, x_m(stamp_ns / 1e9))):
            outputs.append(output)
    return outputs


def real_mapper() -> MappingSession:
    return MappingSession(lambda: build_mapper(mapping_config(), {"front": SE2()}), ["front"])


def test_the_motion_in_a_pause_is_known_after_it():
    """A pause that is longer than the motion model keeps its samples; the vehicle soon stops in it."""

    def x_m(at_s: float) -> float:
        return min(0.5 * at_s, 2.0)

    mapper = real_mapper()
    drive(mapper, range(50), x_m)
    mapper.carry_out("pause")
    assert drive(mapper, range(50, 5000, 10), x_m) == []
    mapper.carry_out("resume")
    after = drive(mapper, range(5000, 5050), x_m)
    assert {output.state for output in after} == {"ok"}
    assert after[0].pose_map_base.x_m == pytest.approx(2.0 - x_m(0.02), abs=0.02)
    assert after[-1].pose_map_base.x_m == pytest.approx(2.0 - x_m(0.02), abs=0.02)


def test_without_wheels_the_base_is_taken_to_stand_in_a_pause():
    mapper = real_mapper()
    before = drive(mapper, range(50), lambda at_s: 0.5 * at_s, wheels=False)
    mapper.carry_out("pause")
    drive(mapper, range(50, 300), lambda at_s: 0.5, wheels=False)
    mapper.carry_out("resume")
    after = drive(mapper, range(300, 301), lambda at_s: 0.5, wheels=False)
    assert after[0].state == "ok"
    assert after[0].pose_map_base.x_m == pytest.approx(before[-1].pose_map_base.x_m, abs=0.02)


@pytest.mark.parametrize(("period_ns", "applied_at"), [(10, [5, 7]), (15, [4, 6]), (100, [3, 5])])
def test_results_are_applied_a_fixed_time_after_submission(
    period_ns: int, applied_at: list[int], made: list[FakeMapper]
):
    mapper = MappingSession(lambda: made.append(FakeMapper()) or made[-1], ["front"], apply_after_ns=30)
    graph = made[0].graph
    for k in range(1, 10):
        graph.waiting += k in (2, 4)
        mapper.process(scan(k * period_ns))
    assert graph.applied_at == applied_at


def test_a_reset_closes_the_old_graph_and_its_jobs(made: list[FakeMapper]):
    mapper = MappingSession(lambda: made.append(FakeMapper()) or made[-1], ["front"], apply_after_ns=3)
    made[0].graph.waiting = 1
    mapper.process(scan(1))
    mapper.carry_out("reset_map")
    assert made[0].graph.closed
    for k in range(2, 10):
        mapper.process(scan(k))
    assert made[1].graph.applied_at == []


def test_corrections_after_a_reset_are_in_the_odom_of_all_outputs(
    mapper: MappingSession, made: list[FakeMapper]
):
    mapper.process(scan(1))
    mapper.process(scan(2))  # at 1 m
    mapper.carry_out("reset_map")
    (correction,) = mapper.finish().corrections
    assert correction == Correction(7, SE2(2.0, 0.0, 0.0), SE2(1.0, 0.1, 0.0))


def test_a_scan_from_before_the_reset_is_late(mapper: MappingSession, made: list[FakeMapper]):
    mapper.process(scan(5))
    mapper.carry_out("reset_map")
    assert mapper.process(scan(5)) is None
    assert made[1].processed == []
    assert mapper.counters["scans_dropped_late"] == 1
