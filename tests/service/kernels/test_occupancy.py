import math

import numpy as np
import pytest

from service.kernels.occupancy import (
    GRID_TILE_BITS,
    GRID_TILE_CELLS,
    Evidence,
    OccupancyGrid,
    to_per_cent,
    trace_scan,
)
from tests.service.kernels.grids import empty_occupancy

EVIDENCE = Evidence(hit=24, miss=-10, least=-70, most=70)
CELL_M = 0.05
HALF = 2 * GRID_TILE_CELLS


def cells_of(grid: OccupancyGrid) -> np.ndarray:
    """evidence[row + HALF, column + HALF]."""
    cells = np.zeros((2 * HALF, 2 * HALF), int)
    for row, column in np.argwhere(grid.tiles.slots >= 0):
        cells[
            row << GRID_TILE_BITS : (row + 1) << GRID_TILE_BITS,
            column << GRID_TILE_BITS : (column + 1) << GRID_TILE_BITS,
        ] = grid.evidence[grid.tiles.slots[row, column]]
    return cells


def trace(grid: OccupancyGrid, xy: list[tuple[float, float]], number: int = 1, free_range_m: float = 20.0):
    trace_scan(np.array(xy), np.zeros(2), np.zeros(3), grid, EVIDENCE, free_range_m, np.uint16(number))


def beam(grid: OccupancyGrid, u: float, v: float, du: float, dv: float) -> None:
    """One beam from a place, both in cells."""
    start, end = CELL_M * np.array([u, v]), CELL_M * np.array([[u + du, v + dv]])
    trace_scan(end, start, np.zeros(3), grid, EVIDENCE, 20.0, np.uint16(1))


@pytest.mark.parametrize("angle", np.linspace(0.05, 2.0 * math.pi, 37).tolist())
def test_a_beam_clears_just_the_cells_it_passes(angle: float) -> None:
    grid = empty_occupancy(CELL_M)
    u, v, du, dv = 0.3, -0.4, 60.0 * math.cos(angle), 60.0 * math.sin(angle)
    beam(grid, u, v, du, dv)
    share = np.linspace(0.0, 1.0, 200_001)
    sampled = np.floor(np.column_stack((v + dv * share, u + du * share))).astype(int)
    is_new = np.append(True, (np.diff(sampled, axis=0) != 0).any(axis=1))
    passed = {(row, column) for row, column in sampled[is_new].tolist()}
    passed.discard((math.floor(v + dv), math.floor(u + du)))
    cleared = {(row - HALF, column - HALF) for row, column in np.argwhere(cells_of(grid) == -10)}
    assert passed <= cleared  # sampling misses a clipped corner now and then, the traversal does not
    assert len(cleared - passed) <= 1


def test_no_beam_clears_what_another_of_the_scan_hit() -> None:
    grid = empty_occupancy(CELL_M)
    trace(grid, [(2.0, 0.01), (1.0, 0.01)])
    cells = cells_of(grid)
    assert cells[HALF, HALF + 20] == 24
    assert cells[HALF, HALF + 40] == 24
    assert cells[HALF, HALF + 30] == -10


def test_a_cell_hears_each_scan_once() -> None:
    grid = empty_occupancy(CELL_M)
    trace(grid, [(1.01, 0.01), (1.02, 0.02)])
    assert cells_of(grid)[HALF, HALF + 20] == 24
    trace(grid, [(1.01, 0.01)], number=2)
    assert cells_of(grid)[HALF, HALF + 20] == 48


def test_evidence_is_bounded_and_never_reads_as_unseen() -> None:
    grid = empty_occupancy(CELL_M)
    for number in range(1, 20):
        trace(grid, [(1.01, 0.01)], number)
    assert cells_of(grid)[HALF, HALF + 20] == 70
    assert cells_of(grid)[HALF, HALF + 5] == -70
    grid.evidence[grid.evidence == -70] = -24
    grid.evidence[grid.evidence == 70] = 10
    trace(grid, [(1.51, 0.01)], 20)
    assert cells_of(grid)[HALF, HALF + 20] == -1


def test_beams_clear_up_to_the_free_range_only() -> None:
    grid = empty_occupancy(CELL_M)
    trace(grid, [(3.01, 0.01)], free_range_m=1.01)
    cleared = np.flatnonzero(cells_of(grid)[HALF] < 0) - HALF
    assert cleared.tolist() == list(range(20))
    assert cells_of(grid)[HALF, HALF + 60] == 24


def test_per_cent_follow_the_odds_and_report_changes() -> None:
    evidence = np.zeros((2, 2), np.int8)
    evidence[0] = 20, -20
    cells = np.full((2, 2), -1, np.int8)
    assert to_per_cent(evidence, 0.05, cells)
    assert cells.tolist() == [[73, 27], [-1, -1]]
    assert not to_per_cent(evidence, 0.05, cells)
