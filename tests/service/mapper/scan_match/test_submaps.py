import math

import numpy as np
import pytest

from service.estimator.motion import Measurement
from service.geometry.se2 import SE2
from service.kernels.surfels import COLUMNS, COUNT, MEAN_X, MEAN_Y, SurfelGrid
from service.mapper.components import MapChange
from service.mapper.scan_match.submaps import (
    MAX_MISSES,
    NEW_SEGMENT_ERROR,
    Submap,
    SubmapsConfig,
    SurfelSubmaps,
)
from service.outputs import State
from tests.service.mapper.maps.points import match_at, points_of, square

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


def test_finer_cells_hold_the_same_points_and_move_with_them() -> None:
    chain = submaps()
    insert(chain, 0.0)
    submap = chain.matched_to
    assert submap is not None
    assert submap.fine_grid().cell_m == pytest.approx(0.5 * submap.grid().cell_m)
    assert len(surfels_of(submap.fine_grid())) > 1.5 * len(surfels_of(submap.grid()))
    for grid in (submap.grid(), submap.fine_grid()):
        means = surfels_of(grid)[:, MEAN_X : MEAN_Y + 1].copy()
        chain.shorten(square().scan.sensor, 0.01)
        moved_m = np.hypot(*(surfels_of(grid)[:, MEAN_X : MEAN_Y + 1] - means).T)
        assert np.median(moved_m) > 0.006  # by the cosine of incidence
        assert moved_m.max() <= 0.0101


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


def test_lost_scans_extend_the_detached_segment_only() -> None:
    chain = submaps()
    insert(chain, 0.0)
    before = points_in(chain.matched_to)
    for k in range(5):
        assert insert(chain, 50.0 + k, state="lost", is_matched=k > 0).segment == 1
    assert chain.detached is not None
    assert chain.detached.scan_count == 5
    assert points_in(chain.matched_to) == before


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


def test_the_error_against_the_map_fades_with_the_distance_and_not_with_time(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(FIRST_SCANS, 100)
    chain = submaps(memory_m=0.3)
    insert(chain, 0.0)
    assert insert(chain, 0.0).error_left == 1.0
    assert insert(chain, 0.3).error_left == pytest.approx(math.exp(-1.0))


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


def test_points_where_nothing_stands_and_points_behind_walls_contradict_the_map(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(FIRST_SCANS, 20)
    chain = submaps()
    for k in range(8):
        room = square(stamp_ns=k * 50_000_000)
        chain.insert(room, match_at(SE2(), room))
    submap = chain.matched_to
    assert submap is not None
    normals = np.ones((360, 3))

    def contradicting(xy_base: np.ndarray, pose: SE2 | None = None) -> tuple[int, int]:
        at = np.zeros(3) if pose is None else np.array(pose)
        return submap.contradicting(points_of(xy_base), xy_base, normals, at)

    square_m = square().xy_base
    assert contradicting(square_m) == (0, 0)
    in_free, behind = contradicting(0.5 * square_m)
    assert in_free > 300
    assert behind == 0
    in_free, behind = contradicting(3.0 * square_m)  # where no one looked, with the walls before it
    assert in_free == 0
    assert behind > 340
    outside = SE2(30.0, 0.0, 0.0)
    assert contradicting(square_m, outside) == (0, 0)
    in_free, behind = contradicting(20.0 * square_m, outside)  # beams of 10 deg go through the room's walls
    assert in_free == 0
    assert behind <= 10


def test_a_noisy_sensor_makes_rough_walls_of_what_are_planes() -> None:
    """Noise that the sensor has shown is no roughness of the wall."""
    xy = square().xy_base
    noise = 0.03 * np.random.default_rng(3).standard_normal(len(xy))
    noisy = points_of(xy * (1.0 + noise / np.hypot(xy[:, 0], xy[:, 1]))[:, None])

    def planar_share(sigma_m: float) -> float:
        _, normals = submaps().on_walls(noisy._replace(range_sigma_m=sigma_m))
        return float((normals[:, 2] >= 1.0).mean())

    assert planar_share(0.01) < 0.5
    assert planar_share(0.03) > 0.6


def test_a_scan_of_hardly_any_returns_begins_no_segment_and_loses_no_later_scan() -> None:
    chain = submaps()
    room = square()
    chain.insert(room, match_at(SE2(), room))
    few = points_of(square().xy_base[:4])
    change = chain.insert(few, match_at(SE2(1.0, 0.0, 0.0), few, state="lost"))
    assert (change.is_keyframe, change.segment) == (False, 0)
    assert chain.detached is None


def test_of_a_standing_vehicle_each_scan_takes_over_no_more_than_its_share(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(FIRST_SCANS, 25)
    chain = submaps()
    room = square()
    chain.insert(room, match_at(SE2(), room))
    left = [chain.insert(room, match_at(SE2(), room)._replace(inlier_ratio=0.6)).error_left for _ in range(3)]
    assert left == pytest.approx([0.6, 2.0 / 3.0, 0.75])


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
