import math

import numpy as np
import pytest

from service.estimator.motion import Measurement
from service.geometry.se2 import SE2
from service.kernels.surfels import COLUMNS, COUNT, SurfelGrid
from service.mapper.components import MapChange
from service.mapper.scan_match.submaps import (
    MAX_MISSES,
    NEW_SEGMENT_ERROR,
    Submap,
    SubmapsConfig,
    SurfelSubmaps,
)
from service.outputs import State
from tests.service.mapper.maps.points import match_at, square

FIRST_SCANS = "service.mapper.scan_match.submaps.FIRST_SCANS"


def submaps(**changes: float) -> SurfelSubmaps:
    return SurfelSubmaps(SubmapsConfig.model_validate({"keyframe_distance_m": 0.5, **changes}))


@pytest.fixture(autouse=True)
def _taken_standing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(FIRST_SCANS, 1)


def insert(
    chain: SurfelSubmaps, x_m: float, state: State = "ok", theta_rad: float = 0.0, is_matched: bool = True
) -> MapChange:
    """is_matched: of a lost scan, to the detached segment."""
    points, pose = square(), SE2(x_m, 0.0, theta_rad)
    measured = Measurement(pose, np.eye(3), np.eye(3)) if is_matched else None
    return chain.insert(points, match_at(pose, points, state)._replace(measured=measured))


def number(chain: SurfelSubmaps) -> int:
    """Of the sub-map that scans are matched to."""
    assert chain.matched_to is not None
    return chain.matched_to.number


def surfels_of(grid: SurfelGrid) -> np.ndarray:
    """(N, COLUMNS) of those that hold points."""
    surfels = grid.surfels[grid.tiles.slots[grid.tiles.slots >= 0]].reshape(-1, COLUMNS)
    return surfels[surfels[:, COUNT] > 0.0]


def points_in(submap: Submap | None) -> float:
    """How many it holds, in whole cells as in finer ones."""
    assert submap is not None
    whole, fine = (surfels_of(grid)[:, COUNT].sum() for grid in (submap.grid(), submap.fine_grid()))
    assert whole == pytest.approx(fine)
    return float(whole)


def test_the_older_of_two_is_matched_to_and_the_younger_takes_over() -> None:
    chain = submaps(spacing_m=2.0)
    numbers = []
    for k in range(17):
        insert(chain, 0.5 * k)
        numbers.append(number(chain))
    assert numbers == [0] * 8 + [1] * 4 + [2] * 4 + [3]


def test_tiles_of_retired_submaps_go_back_to_the_pool() -> None:
    chain = submaps(spacing_m=2.0)
    counts = []
    for k in range(200):
        insert(chain, 0.5 * k)
        counts.append(chain.tile_count)
    assert max(counts[100:]) <= max(counts[:40])


def test_a_lost_scan_begins_a_detached_segment_that_a_fit_drops() -> None:
    chain = submaps()
    assert insert(chain, 0.0).segment == 0
    before, tiles = points_in(chain.matched_to), chain.tile_count
    change = insert(chain, 1.0, state="lost", is_matched=False)
    assert (change.segment, change.is_keyframe) == (1, True)
    assert change.error_left < 0.05  # the segment begins at the pose
    assert number(chain) == 0
    assert points_in(chain.matched_to) == before
    assert points_in(chain.detached) > 0.0
    insert(chain, 1.2)
    assert chain.detached is None
    assert number(chain) == 0
    assert chain.tile_count <= tiles + 6  # of the key frame at 1.2 m; those of the segment went back


def test_a_detached_segment_is_the_map_only_once_the_graph_has_joined_it() -> None:
    chain = submaps()
    insert(chain, 0.0)
    insert(chain, 50.0, state="lost", is_matched=False)
    assert number(chain) == 0
    detached = chain.detached
    chain.join(2)  # another segment, unknown here
    assert (number(chain), chain.detached) == (0, detached)
    chain.join(1)
    assert (chain.matched_to, chain.detached) == (detached, None)
    assert insert(chain, 50.6).segment == 1
    assert points_in(detached) > 0.0
    assert detached is not None
    assert detached.scan_count == 2
    chain.join(1)  # once more: it is joined already
    assert chain.matched_to is detached


def test_scans_that_fit_neither_map_nor_segment_begin_another_segment() -> None:
    chain = submaps()
    insert(chain, 0.0)
    segments = [insert(chain, 50.0, state="lost", is_matched=k == 1).segment for k in range(MAX_MISSES + 3)]
    assert segments == [1] * (MAX_MISSES + 1) + [2] * 2
    chain.join(1)  # too late
    assert chain.detached is not None
    assert number(chain) == 0
    assert chain.detached.scan_count == 1


@pytest.mark.parametrize("place", [(0.0, 0.0), (-1234.5, 876.5), (-0.05, -0.05)])
def test_a_room_is_the_same_wherever_it_stands(place: tuple[float, float]) -> None:
    chain = submaps()
    points = square()
    chain.insert(points, match_at(SE2(*place, 0.0), points))
    assert chain.matched_to is not None
    grid = chain.matched_to.grid()
    found = []
    for row, column in np.argwhere(grid.tiles.slots >= 0):
        tile = grid.surfels[grid.tiles.slots[row, column]]
        for r, c, side in np.argwhere(tile[:, :, :, 0] > 0.0):
            x = ((column + grid.tiles.origin[1]) * 32 + c + 0.5) * 0.1 + tile[r, c, side, 1] - place[0]
            y = ((row + grid.tiles.origin[0]) * 32 + r + 0.5) * 0.1 + tile[r, c, side, 2] - place[1]
            found.append(max(abs(x), abs(y)))
    np.testing.assert_allclose(found, 2.0, atol=3e-5)
    assert len(found) > 100


@pytest.mark.parametrize(
    ("turn_rad", "ratio", "left"),
    [
        (0.1, 1.0, math.exp(-0.1 / (2.0 * math.pi))),
        (math.pi, 1.0, math.exp(-0.5)),  # of a view of a full turn half is new
        (0.1, 0.4, 0.4),  # so much of the scan lay on the map, the rest takes the pose's error over
        (0.1, 0.0, NEW_SEGMENT_ERROR),
    ],
)
def test_the_map_takes_over_the_error_of_the_pose_as_far_as_it_shows_new_ground(
    turn_rad: float, ratio: float, left: float
) -> None:
    chain = submaps()
    room = square()
    chain.insert(room, match_at(SE2(), room))
    change = chain.insert(room, match_at(SE2(0.0, 0.0, turn_rad), room)._replace(inlier_ratio=ratio))
    assert change.is_keyframe
    assert change.error_left == pytest.approx(left, rel=1e-9)
