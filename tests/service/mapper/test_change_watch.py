"""What a cell needs before it is reported as changed, each condition by itself: one tile, seen by hand."""

from dataclasses import dataclass

import numpy as np
import pytest

from service.geometry.se2 import SE2
from service.kernels.map_changes import CELL_FREE
from service.mapper.components import RenderedMap
from service.mapper.map_changes import (
    MIN_CELLS,
    MIN_CHANGED_SHARE,
    MIN_MS,
    MIN_POSES,
    MIN_VOTES,
    ChangeWatch,
    MapChanges,
)
from tests.service.mapper.maps.points import points_of

CELL_M, EDGE = 0.05, 64
STEP_M = 0.31  # from pose to pose: each counts as another
MS = 1_000_000
BOX = [(2.05, 1.25), (2.05, 1.35), (2.05, 1.45), (2.05, 1.55)]  # middles of four cells of changes, m


@dataclass
class Room:
    """Free space with walls of the stored map: cells of 0.1 m, in m."""

    walls: tuple[tuple[float, float], ...] = ()

    def __post_init__(self) -> None:
        evidence = np.full((1, EDGE, EDGE), -40, np.int8)
        for x_m, y_m in self.walls:
            column, row = (round((middle_m - CELL_M) / CELL_M) for middle_m in (x_m, y_m))
            evidence[0, row : row + 2, column : column + 2] = 60
        zero = np.zeros(1, np.int64)
        self.watch = ChangeWatch(RenderedMap(zero, zero, evidence), CELL_M)

    def see(self, ends, pose_x_m: float, at_ms: float) -> None:
        pose = SE2(pose_x_m, 1.5, 0.0)
        self.watch.add(points_of(np.array(ends) - (pose_x_m, 1.5)), pose, round(at_ms * MS))

    def see_from(self, ends, poses: int, scans: int, over_ms: float) -> None:
        """So many scans in all, evenly over the time, from so many poses one after the other."""
        for k in range(scans):
            self.see(ends, 0.3 + STEP_M * (k * poses // scans), k * over_ms / (scans - 1))

    def changes(self) -> MapChanges:
        return self.watch.changes()


def ends_through(cells, pose_x_m: float, times: float = 1.6) -> list[tuple[float, float]]:
    """Of beams that go through the middles of cells and on: so many times as far."""
    return [(pose_x_m + times * (x - pose_x_m), 1.5 + times * (y - 1.5)) for x, y in cells]


def facts(room: Room) -> list[tuple[float, float]]:
    return sorted((round(float(x), 2), round(float(y), 2)) for x, y in room.changes().xy_map)


def test_an_object_in_free_space_is_reported_after_three_poses() -> None:
    for poses, expected in ((2, []), (3, BOX)):
        room = Room()
        room.see_from(BOX, poses, scans=6, over_ms=1500.0)
        assert facts(room) == expected
    assert room.changes().is_new.all()


@pytest.mark.parametrize(("scans", "expected"), [(4, []), (5, BOX)])
def test_five_scans_must_contradict_the_map(scans: int, expected: list) -> None:
    room = Room()
    room.see_from(BOX, 3, scans, over_ms=1500.0)
    assert facts(room) == expected


@pytest.mark.parametrize(("over_ms", "expected"), [(990.0, []), (1000.0, BOX)])
def test_a_second_must_pass_since_the_first_contradiction(over_ms: float, expected: list) -> None:
    room = Room()
    room.see([(0.9, 0.9)], 0.3, -2000.0)  # a scan without one
    room.see_from(BOX, 3, scans=5, over_ms=over_ms)
    assert facts(room) == expected


@pytest.mark.parametrize(("every_ms", "scans"), [(100.0, 3), (200.0, 5)])
def test_at_standstill_five_scans_a_second_are_evaluated(every_ms: float, scans: int) -> None:
    room = Room()
    room.see_from(BOX, 3, scans=9, over_ms=1600.0)
    for k in range(5):
        room.see(BOX, 0.3 + 2 * STEP_M, 2000.0 + every_ms * k)
    assert (room.changes().scans == 9 + scans).all()


@pytest.mark.parametrize(("clear", "expected"), [(2, BOX), (3, [])])
def test_four_scans_of_five_must_agree(clear: int, expected: list) -> None:
    """8 that contradict and 2 that do not are 80 %; with 3 they are 73 %."""
    room = Room()
    room.see_from(BOX, 3, scans=8, over_ms=1600.0)
    for k in range(clear):
        room.see(ends_through(BOX, 0.3), 0.3, 1900.0 + 300.0 * k)
    assert facts(room) == expected


@pytest.mark.parametrize("gone", [False, True])
@pytest.mark.parametrize(
    ("cells", "expected"),
    [
        (BOX[:3], []),  # the edge of an unchanged object
        (BOX, BOX),
        ([(1.95, 1.15), (2.05, 1.25), (2.15, 1.35), (2.25, 1.45)], "all"),  # by corners
        ([*BOX[:3], (2.05, 1.75), (2.05, 1.85), (2.05, 1.95)], []),  # two threes are no six
        ([*BOX, (2.05, 1.85)], BOX),  # one apart from four
    ],
)
def test_four_cells_must_be_connected(cells: list, expected: list | str, gone: bool) -> None:
    room = Room(walls=tuple(cells)) if gone else Room()
    for k in range(8):
        pose_x_m = (0.3, 0.6, 0.9)[k % 3]
        room.see(ends_through(cells, pose_x_m) if gone else cells, pose_x_m, 300.0 * k)
    assert facts(room) == (sorted(cells) if expected == "all" else expected)
    assert (room.changes().is_new == (not gone)).all()


def test_a_return_beside_a_mapped_wall_belongs_to_it() -> None:
    room = Room(walls=tuple(BOX))
    room.see_from([(x - 0.1, y) for x, y in BOX], 3, scans=8, over_ms=1600.0)
    assert facts(room) == []


@pytest.mark.parametrize(("times", "gone"), [(1.16, 0), (1.4, len(BOX))])
def test_a_beam_that_ends_close_behind_a_wall_does_not_contradict_it(times: float, gone: int) -> None:
    """1.15 to 1.75 m ahead is the wall: the beams end 0.2 to 0.3 m behind it, then 0.5 to 0.7 m."""
    room = Room(walls=tuple(BOX))
    for k in range(8):
        pose_x_m = (0.3, 0.6, 0.9)[k % 3]
        room.see(ends_through(BOX, pose_x_m, times), pose_x_m, 300.0 * k)
    assert (~room.changes().is_new).sum() == gone


def sure_cells(watch: ChangeWatch, is_new: bool) -> set[tuple[int, int]]:
    """Row and column, evaluated one by one."""
    votes = watch.votes
    return {
        at
        for at in np.ndindex(votes.stored.shape)
        if (votes.stored[at] == CELL_FREE) == is_new
        and votes.poses[at] >= MIN_POSES
        and votes.changed[at] >= MIN_VOTES
        and votes.last_ms[at] - votes.first_ms[at] >= MIN_MS
        and int(votes.changed[at]) >= MIN_CHANGED_SHARE * (int(votes.changed[at]) + int(votes.same[at]))
    }


def in_groups(cells: set[tuple[int, int]]) -> set[tuple[int, int]]:
    """Without groups of too few connected cells, by flood fill."""
    kept: set[tuple[int, int]] = set()
    left = set(cells)
    while left:
        group, ends = [], [left.pop()]
        while ends:
            row, column = ends.pop()
            group.append((row, column))
            near = {(row + dr, column + dc) for dr in (-1, 0, 1) for dc in (-1, 0, 1)} & left
            left -= near
            ends += near
        if len(group) >= MIN_CELLS:
            kept |= set(group)
    return kept


@pytest.mark.parametrize("share", [0.0, 0.2, 0.35, 0.6])
@pytest.mark.parametrize("seed", range(4))
def test_reported_cells_equal_those_of_a_reference_in_plain_loops(seed: int, share: float) -> None:
    """Groups of all shapes, also at the edges of the map; rows first."""
    watch, random = Room().watch, np.random.default_rng(seed)
    votes, shape = watch.votes, watch.votes.stored.shape
    votes.stored[:] = random.integers(0, 3, shape)
    votes.poses[:] = np.where(random.random(shape) < share, 3, random.integers(0, 3, shape))
    votes.changed[:], votes.same[:] = random.integers(4, 200, shape), random.integers(0, 30, shape)
    votes.first_ms[:], votes.last_ms[:] = random.integers(0, 50, shape), random.integers(1000, 9000, shape)
    new, gone = in_groups(sure_cells(watch, is_new=True)), in_groups(sure_cells(watch, is_new=False))
    expected = sorted(new | gone)
    row, column = np.array(expected, np.int64).reshape(-1, 2).T
    changes = watch.changes()
    np.testing.assert_array_equal(changes.xy_map, (np.column_stack((column, row)) + 0.5) * votes.cell_m)
    assert [bool(is_new) for is_new in changes.is_new] == [at in new for at in expected]
    for found, of, unit in (
        (changes.first_ns, votes.first_ms, MS),
        (changes.last_ns, votes.last_ms, MS),
        (changes.scans, votes.changed, 1),
    ):
        assert found.dtype == np.int64
        np.testing.assert_array_equal(found, of[row, column].astype(np.int64) * unit)
