"""The scan's own map and what is learned from it, cell by cell."""

import math

import numpy as np
import pytest

from service.kernels import background, contour_blur
from service.kernels.background import LearningSettings, learn_scan, mark_passed
from service.kernels.contour_blur import (
    BLURRED,
    HIT,
    PASSED,
    BlurSettings,
    LikelihoodLevel,
    ScanCells,
    blur_scan,
    clear_scan,
)
from service.kernels.surfels import TILE_CELLS
from tests.service.kernels.grids import empty_tiles
from tests.service.kernels.inner import from_python

interpolated = from_python(background.interpolated)
spread_falls = from_python(background.spread_falls)
touch_cell = from_python(contour_blur.touch_cell)

BLUR = BlurSettings(10.0, 1.5, False, 0.01, True)
PRINTED = LearningSettings(0.01, 3.0, 100, 1.5, True, False)
AVERAGED = PRINTED._replace(is_printed=False)
CELL_M = 0.1
ORIGIN = np.zeros(3)
SENSOR = np.array([0.05, 0.05])


def empty_level() -> LikelihoodLevel:
    tiles = empty_tiles()
    shape = (len(tiles.free), TILE_CELLS, TILE_CELLS)
    floats = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    return LikelihoodLevel(tiles, *floats, np.zeros(shape, np.uint16), np.zeros(shape, np.int32), CELL_M)


def room(count: int = 20_000) -> ScanCells:
    place, kind = np.empty((count, 3), np.int32), np.empty(count, np.uint8)
    values = np.empty(count, np.float32), np.empty(count, np.float32)
    return ScanCells(place, kind, *values, np.zeros(1, np.int64))


def at(layer: np.ndarray, level: LikelihoodLevel, row: int, column: int) -> float:
    slot = level.tiles.slots[row // TILE_CELLS + 2, column // TILE_CELLS + 2]
    return float(layer[slot, row % TILE_CELLS, column % TILE_CELLS])


def blurred_cells(xy: np.ndarray, settings: BlurSettings = BLUR) -> dict[tuple[int, int], tuple[int, float]]:
    level, cells = empty_level(), room()
    blur_scan(np.ascontiguousarray(xy), np.zeros(len(xy), np.int32), ORIGIN, level, settings, cells)
    return {
        (int(cells.place[k, 1]), int(cells.place[k, 2])): (int(cells.kind[k]), float(cells.value[k]))
        for k in range(cells.rows[0])
    }


def test_beside_a_straight_contour_the_blur_is_that_of_its_formula() -> None:  # A17 A18 A20
    x = np.array([0.03, 0.38, 0.79, 1.21])
    cells = blurred_cells(np.column_stack([x, np.full(4, 0.02)]))
    for row in range(-9, 9):
        for column in range(1, 12):
            u, v = (column + 0.5) * CELL_M, (row + 0.5) * CELL_M
            expected = math.exp(-np.abs(u - x).min() / CELL_M / 10.0 - abs(v - 0.02) / CELL_M / 1.5)
            value = cells.get((row, column), (BLURRED, 0.0))[1]
            assert value == pytest.approx(expected if expected >= 0.01 else 0.0, abs=1e-5)
    assert cells[0, 0][0] == HIT
    assert cells[0, 3][0] == HIT
    assert cells[1, 5][0] == BLURRED


def see(level: LikelihoodLevel, kind: int, value: float, settings: LearningSettings) -> None:
    """One scan that observes only cell (0, 0)."""
    cells = room()
    touch_cell(level, 0, 0, cells)
    cells.kind[0], cells.value[0] = kind, value
    learn_scan(level, settings, cells)
    clear_scan(level, cells)


def test_one_cell_through_hits_and_passes() -> None:  # A34 A35 A36 A37
    level = empty_level()
    see(level, HIT, 0.8, PRINTED)
    assert at(level.likelihood, level, 0, 0) == pytest.approx(0.8)
    see(level, HIT, 0.5, PRINTED)
    rate = 0.01 * (1.0 + 3.0 * 0.8)
    expected = (1.0 - rate) * 0.8 + rate
    assert at(level.likelihood, level, 0, 0) == pytest.approx(expected, rel=1e-6)
    assert at(level.seen, level, 0, 0) == 2
    see(level, PASSED, 0.0, PRINTED)
    faded = (1.0 - 0.01 / (1.0 + 3.0 * expected)) * expected
    assert at(level.likelihood, level, 0, 0) == pytest.approx(faded, rel=1e-6)
    assert at(level.highest, level, 0, 0) == pytest.approx(expected, rel=1e-6)
    assert at(level.seen, level, 0, 0) == 2


def test_a_wall_on_the_border_of_two_cells_stays() -> None:  # A48 A49
    """Noise hits now one of them, now the other; the likelier one is what a match finds."""
    noise = np.random.default_rng(4)
    level = empty_level()
    for hit in noise.random(2000) < 0.5:
        see(level, HIT if hit else BLURRED, 0.95 if hit else 0.6, AVERAGED)
    assert at(level.likelihood, level, 0, 0) > 0.97


@pytest.mark.parametrize("bounded", [True, False])
def test_interpolation_agrees_with_brute_force(bounded: bool) -> None:  # A39
    noise = np.random.default_rng(3)
    level, cells = empty_level(), room()
    settings = PRINTED._replace(is_bounded=bounded)
    kinds = noise.choice([PASSED, BLURRED, HIT], (14, 14), p=[0.2, 0.6, 0.2])
    for row in range(14):
        for column in range(14):
            k = touch_cell(level, row - 7, column - 7, cells)
            cells.kind[k] = kinds[row, column]
            cells.value[k] = 0.5 if kinds[row, column] else 0.0
            slot, r, q = cells.place[k, 0], (row - 7) % TILE_CELLS, (column - 7) % TILE_CELLS
            level.likelihood[slot, r, q] = noise.random()
    now = np.array([[at(level.likelihood, level, r - 7, c - 7) for c in range(14)] for r in range(14)])
    spread_falls(level, settings, cells)
    rows, columns = np.indices(now.shape)
    for r, c in np.argwhere(kinds == BLURRED):
        far = np.hypot(rows - r, columns - c)
        change = (now - now[r, c]) * np.exp(-far / 1.5)
        near = far <= 4.5
        rise = change[near & (kinds == HIT)].max(initial=-9.0)
        rise = 0.0 if rise == -9.0 or (bounded and now[r, c] >= 0.5) else rise
        fall = min(change[near & (kinds == PASSED)].min(initial=0.0), 0.0)
        expected = now[r, c] + (rise if abs(rise) > abs(fall) else fall)
        if bounded and abs(rise) > abs(fall):
            expected = max(now[r, c], min(expected, 0.5))
        k = r * 14 + c
        got = interpolated(level, k, now[r, c], 0.5, settings, cells)
        assert got == pytest.approx(min(max(expected, 0.0), 1.0), abs=1e-6)


def test_only_what_a_beam_passed_fades_and_behind_it_all_stays() -> None:  # A37
    level, cells = empty_level(), room()
    wall = np.array([[1.0, 0.05], [1.05, 0.05]])
    blur_scan(wall, np.zeros(2, np.int32), ORIGIN, level, BLUR, cells)
    learn_scan(level, PRINTED, cells)
    clear_scan(level, cells)
    near = np.array([[0.2, 0.05]])
    mark_passed(near, SENSOR, ORIGIN, level, 100, 20.0, cells)
    assert cells.rows[0] == 0
    far = np.array([[2.0, 0.05]])
    mark_passed(far, SENSOR, ORIGIN, level, 100, 20.0, cells)
    assert cells.rows[0] > 0
    assert set(cells.place[: cells.rows[0], 1]) == {0}
    clear_scan(level, cells)
    mark_passed(far, SENSOR, ORIGIN, level, 0, 20.0, cells)  # A38: seen more often than that
    assert cells.rows[0] == 0


def test_a_traditional_contour_is_as_likely_between_its_points() -> None:  # A10
    sparse = np.array([[0.05, 0.05], [1.05, 0.05]])
    ours = blurred_cells(sparse, BLUR._replace(along_cells=1.5))
    traditional = blurred_cells(sparse, BLUR._replace(along_cells=math.inf))
    assert ours[0, 5][1] < 0.05
    assert traditional[0, 5] == (HIT, traditional[0, 0][1])


def test_the_squared_blur_is_a_gaussian() -> None:  # A9
    cells = blurred_cells(np.array([[0.05, 0.05], [0.15, 0.05]]), BLUR._replace(is_squared=True))
    assert cells[2, 0][1] == pytest.approx(math.exp(-0.5 * (2.0 / 1.5) ** 2), abs=1e-6)
