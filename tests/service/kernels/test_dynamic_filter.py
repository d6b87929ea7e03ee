import math

import numpy as np
import pytest

from service.kernels import tiles
from service.kernels.static_score import (
    Observations,
    StaticScoreSettings,
    count_hits,
    remove_by_ray_cast,
    weigh_static_score,
)
from service.kernels.static_walls import count_beams_through_walls, find_dynamic, static_residuals
from service.kernels.surfels import PARTS, TILE_BITS, TILE_MASK, SurfelGrid, insert_surfels
from tests.service.kernels.grids import empty_grid
from tests.service.kernels.inner import from_python

find_tile = from_python(tiles.find_tile)

SETTINGS = StaticScoreSettings(
    full_score=10, max_free=3, least_weight=0.1, most_gain=2.0, behind_m=0.2, beam_step=1
)
SENSOR, POSE = np.zeros(2), np.array([0.31, -0.17, 0.4])


class CandidateSubmap:
    """A sub-map whose key frames are all taken from POSE."""

    def __init__(self, settings: StaticScoreSettings = SETTINGS) -> None:
        self.grid: SurfelGrid = empty_grid()
        self.fine_grid: SurfelGrid = empty_grid(self.grid.cell_m / PARTS, half_tiles=4 * PARTS)
        shape = self.grid.field.shape
        marks = np.zeros(shape, np.uint16), np.zeros((*shape, 2), np.uint16)
        self.observations = Observations(np.zeros(shape, np.int8), *marks)
        self.settings = settings
        self.number = 0

    def see(self, xy: np.ndarray, normals: np.ndarray, ticks: int = 1, mark: int = 1) -> np.ndarray:
        """One more key frame, so long after the last; the weights of its points then."""
        self.number += 1
        kept = normals.copy()
        numbers = np.uint16(self.number), np.int64(ticks)
        count_hits(xy, kept, POSE, self.grid, self.observations, self.settings, *numbers, np.uint16(mark))
        grids = self.grid, self.fine_grid
        remove_by_ray_cast(xy, SENSOR, POSE, *grids, self.observations, self.settings, *numbers)
        for grid in grids:
            insert_surfels(xy, kept, POSE, grid, 1000.0, 1.0, np.zeros(2), -1)
        return kept[:, 2]

    def weights(self, xy: np.ndarray, normals: np.ndarray) -> np.ndarray:
        weighed = normals.copy()
        weigh_static_score(xy, POSE, self.grid, self.observations, self.settings, weighed)
        return weighed[:, 2]

    def scores(self, xy: np.ndarray) -> np.ndarray:
        return np.array([self.observations.score[cell] for cell in cells_of(self.grid, xy)])

    def point_counts(self, xy: np.ndarray) -> float:
        """By the surfels of the cells in which the points lie; finer cells hold as many."""
        counts = [
            float(sum(grid.surfels[cell][:, 0].sum() for cell in set(cells_of(grid, xy))))
            for grid in (self.grid, self.fine_grid)
        ]
        assert counts[0] == counts[1]
        return counts[0]


def cells_of(grid: SurfelGrid, xy: np.ndarray) -> list[tuple[int, int, int]]:
    """In which points (N, 2) of the base lie: slot, row, column."""
    c, s = math.cos(POSE[2]), math.sin(POSE[2])
    cells = []
    for x, y in xy @ np.array([[c, s], [-s, c]]) + POSE[:2]:
        row, column = math.floor(y / grid.cell_m), math.floor(x / grid.cell_m)
        slot = find_tile(grid.tiles, row >> TILE_BITS, column >> TILE_BITS)
        cells.append((int(slot), row & TILE_MASK, column & TILE_MASK))
    return cells


def wall(distance_m: float, half_rad: float = 0.4, beams: int = 161) -> tuple[np.ndarray, np.ndarray]:
    """Square to the x axis, so far ahead: points and normals."""
    angle = np.linspace(-half_rad, half_rad, beams)
    xy = np.column_stack([np.full(beams, distance_m), distance_m * np.tan(angle)])
    return xy, np.tile([-1.0, 0.0, 1.0], (beams, 1))


def side_wall(aside_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Along the x axis, seen ever more obliquely."""
    angle = np.linspace(1.5, 0.08, 300)
    xy = np.column_stack([aside_m / np.tan(angle), np.full(300, aside_m)])
    return xy, np.tile([0.0, -1.0, 1.0], (300, 1))


def test_a_cell_counts_time_and_not_beyond_enough() -> None:
    place = CandidateSubmap()
    xy, normals = wall(2.0)
    for k in range(1, 15):
        place.see(xy, normals)
        assert set(place.scores(xy)) == {min(k, SETTINGS.full_score)}
    other = CandidateSubmap()
    expected = (1, 5, 9, 10)  # when it was seen first, no one knows for how long it had been there
    for score in expected:
        other.see(xy, normals, ticks=4)
        assert set(other.scores(xy)) == {score}


def test_what_is_looked_through_goes_and_what_is_behind_stays() -> None:
    place = CandidateSubmap()
    near, far = wall(2.0, 0.2), wall(3.0)
    for _ in range(6):
        place.see(*near)
    assert place.point_counts(near[0]) == 6 * len(near[0])
    left = [place.point_counts(near[0])]
    for _ in range(6):
        place.see(*far)
        left.append(place.point_counts(near[0]))
    assert left[5] == left[0]  # six key frames saw it, and each beam through it takes one away
    assert left[6] == 0.0
    assert place.point_counts(far[0]) == 6 * len(far[0])


def test_a_wall_that_the_beams_pass_along_stays() -> None:
    place = CandidateSubmap()
    xy, normals = side_wall(0.8)
    place.see(xy, normals)
    counts = place.point_counts(xy)
    rng = np.random.default_rng(3)
    for _ in range(10):  # beams that end on its far half, with noise across it, pass over the near half
        beams = rng.choice(np.arange(150, 300), 80)
        xy_again = xy[beams] + rng.normal(0.0, 0.012, (80, 2))
        place.see(xy_again, np.column_stack([np.zeros(80), np.zeros(80), np.zeros(80)]))
    assert place.point_counts(xy) == counts


def test_the_far_side_of_a_thin_wall_is_not_looked_through() -> None:
    place = CandidateSubmap()
    xy, _ = wall(2.0, 0.2)
    facing_away = np.tile([1.0, 0.0, 1.0], (len(xy), 1))
    place.see(xy, facing_away)
    place.see(*wall(3.0))
    assert place.point_counts(xy) == len(xy)


def test_what_comes_into_free_space_has_to_stay_before_it_is_taken() -> None:
    place = CandidateSubmap()
    near, far = wall(2.0, 0.2), wall(3.0)
    for _ in range(9):
        place.see(*far)
    assert set(place.scores(near[0])) == {-SETTINGS.max_free}
    weights = [place.see(*near).max() for _ in range(5)]
    assert weights == [0.0, 0.0, 0.0, 1.0, 1.0]


def residuals(
    place: CandidateSubmap, xy: np.ndarray, normals: np.ndarray, latest: int, latest_arrived: int
) -> np.ndarray:
    residual_m = np.empty(len(xy))
    static_residuals(
        xy, normals, POSE, place.grid, place.observations, 0.6, latest, latest_arrived, residual_m
    )
    return residual_m


def moved(place: CandidateSubmap, xy: np.ndarray, latest: int, normal=(-1.0, 0.0, 1.0)) -> np.ndarray:
    is_dynamic = np.zeros(len(xy), np.bool_)
    find_dynamic(xy, np.tile(normal, (len(xy), 1)), POSE, place.grid, place.observations, latest, is_dynamic)
    return is_dynamic


def test_a_wall_is_static_from_the_mark_at_which_it_was_first_seen() -> None:
    place = CandidateSubmap()
    xy, normals = wall(2.0)
    for mark in range(5, 15):
        place.see(xy, normals, mark=mark)
    assert np.isnan(residuals(place, xy, normals, 4, 99)).all()
    near = xy - np.array([0.03, 0.0])
    np.testing.assert_allclose(residuals(place, near, normals, 5, 0), 0.03, atol=0.005)


def test_points_in_known_free_space_have_moved_and_new_ground_has_not() -> None:
    place = CandidateSubmap()
    near, far = wall(2.0, 0.2), wall(3.0)
    place.see(*near)  # with a tile: free space is known where something is near
    for _ in range(12):
        place.see(*far)
    beyond, _ = wall(3.5, 0.2)
    assert moved(place, near[0], 1).all()
    assert not moved(place, far[0], 1).any()
    assert not moved(place, beyond, 1).any()


@pytest.mark.parametrize("weight", [1.0, 0.0])
def test_a_wall_that_comes_into_view_beside_the_beams_has_not_moved(weight: float) -> None:
    """Beams have passed through its cells, but not behind it."""
    place = CandidateSubmap()
    ahead, normals = wall(3.0, 0.1)
    for _ in range(12):
        place.see(ahead, normals)
    along = np.column_stack([np.linspace(1.5, 2.5, 21), np.linspace(0.14, 0.24, 21)])
    assert (place.scores(along) < 0).all()
    assert moved(place, along, 1, (0.1, -0.995, weight)).mean() < 0.3  # border cells are free in part
    assert moved(place, along - np.array([0.0, 0.15]), 1, (0.1, -0.995, weight)).all()


def test_an_object_in_free_space_is_dynamic_until_it_stayed_over_enough_of_the_path() -> None:
    place = CandidateSubmap()
    near, far = wall(2.0, 0.2), wall(3.0)
    place.see(*near)
    for _ in range(12):
        place.see(*far)
    for _ in range(8):
        place.see(*near, mark=30)
    assert place.scores(near[0]).min() > 0
    assert moved(place, near[0], 29).all()
    assert not moved(place, near[0], 30).any()
    assert np.isnan(residuals(place, *near, 99, 29)).all()
    assert np.isfinite(residuals(place, *near, 0, 30)).all()


def test_beams_that_end_behind_a_static_wall_pass_through_it() -> None:
    place = CandidateSubmap()
    near, far = wall(2.0), wall(3.0, 0.3)
    for _ in range(10):
        place.see(*near, mark=7)
    through = [
        count_beams_through_walls(xy, SENSOR, POSE, place.grid, place.observations, latest, SETTINGS.behind_m)
        for xy, latest in ((far[0], 7), (far[0], 6), (near[0], 7))
    ]
    assert through[0] >= 0.9 * len(far[0])
    assert through[1:] == [0, 0]
