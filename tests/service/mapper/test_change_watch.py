"""What a cell needs before it is reported as changed, each condition by itself: one tile, seen by hand."""

from dataclasses import dataclass

import numpy as np
import pytest

from service.geometry.se2 import SE2
from service.mapper.components import RenderedMap
from service.mapper.map_changes import ChangeWatch, MapChanges
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


@pytest.mark.parametrize(("poses", "scans", "expected"), [(3, 4, []), (3, 5, BOX), (2, 6, []), (1, 6, [])])
def test_five_scans_from_three_poses_must_contradict_the_map(poses: int, scans: int, expected: list) -> None:
    room = Room()
    room.see_from(BOX, poses, scans, over_ms=1500.0)
    assert facts(room) == expected


@pytest.mark.parametrize(("over_ms", "expected"), [(990.0, []), (1000.0, BOX)])
def test_a_second_must_pass_since_the_first_contradiction(over_ms: float, expected: list) -> None:
    room = Room()
    room.see([(0.9, 0.9)], 0.3, -2000.0)  # a scan without one
    room.see_from(BOX, 3, scans=5, over_ms=over_ms)
    assert facts(room) == expected


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
