import math

import numpy as np
import pytest

from service.kernels import counted_occupancy, tiles
from service.kernels.counted_occupancy import MAX_COUNT, CountWeights
from service.kernels.surfels import TILE_BITS, TILE_MASK
from service.kernels.tiles import NO_TILE
from service.mapper.papers.submap_graph.counted_submaps import CountedMap, CountedSubmapsConfig
from tests.service.kernels.inner import from_python

occupied_probability = from_python(counted_occupancy.occupied_probability)
find_tile = from_python(tiles.find_tile)

CONFIG = CountedSubmapsConfig(cell_m=0.1, free_range_m=5.0, pass_stride=1)
WEIGHTS = CONFIG.weights
SENSOR = np.zeros(2)


def counts_at(counted: CountedMap, x_m: float, y_m: float) -> tuple[int, int, float]:
    grid = counted.grid()
    row, column = math.floor(y_m / 0.1), math.floor(x_m / 0.1)
    slot = find_tile(grid.tiles, row >> TILE_BITS, column >> TILE_BITS)
    if slot == NO_TILE:
        return 0, 0, 0.0
    place = slot, row & TILE_MASK, column & TILE_MASK
    return int(grid.hits[place]), int(grid.passes[place]), float(grid.field[place])


# D6
@pytest.mark.parametrize(("hits", "passes"), [(0, 0), (1, 0), (0, 1), (3, 2), (2, 9), (40, 17)])
def test_counts_give_the_probability_of_log_odds(hits: int, passes: int) -> None:
    """Against the printed product of probabilities, and against adding log-odds scan by scan."""
    o, f = 0.7, 0.4
    weights = CountWeights(math.log(o / (1 - o)), math.log(f / (1 - f)))
    found = occupied_probability(hits, passes, weights)
    product = o**hits * f**passes
    complement = (1 - o) ** hits * (1 - f) ** passes
    assert found == pytest.approx(product / (product + complement), rel=1e-12)
    log_odds = sum([math.log(o / (1 - o))] * hits + [math.log(f / (1 - f))] * passes)
    assert found == pytest.approx(1 / (1 + math.exp(-log_odds)), rel=1e-12)


# D6, D7
def test_a_beam_counts_free_cells_and_its_end() -> None:
    counted = CountedMap(CountedMap.new_pool(64), CONFIG)
    for _ in range(3):
        counted.insert(np.array([[2.05, 0.05]]), SENSOR, np.array([0.0, 0.0, 0.0]))
    assert counts_at(counted, 2.05, 0.05)[:2] == (3, 0)
    assert counts_at(counted, 2.05, 0.05)[2] == pytest.approx(occupied_probability(3, 0, WEIGHTS), rel=1e-6)
    assert counts_at(counted, 1.05, 0.02)[:2] == (0, 3)
    assert counts_at(counted, 1.05, 0.02)[2] == 0.0  # nothing ever ended there
    assert counts_at(counted, 2.25, 0.05)[:2] == (0, 0)  # behind the wall
    counted.insert(np.array([[3.05, 0.075]]), SENSOR, np.zeros(3))  # the thing at 2 m has gone
    assert counts_at(counted, 2.05, 0.05)[:2] == (3, 1)


def test_a_scan_counts_once_in_a_cell_and_a_hit_wins() -> None:
    counted = CountedMap(CountedMap.new_pool(64), CONFIG)
    ends = np.array([[2.05, 0.05], [2.06, 0.05], [4.0, 0.1]])  # the third beam passes the cell of the others
    counted.insert(ends, SENSOR, np.zeros(3))
    assert counts_at(counted, 2.05, 0.05)[:2] == (1, 0)
    assert counts_at(counted, 1.05, 0.02)[:2] == (0, 1)


# D7
def test_counts_stay_at_their_greatest() -> None:
    counted = CountedMap(CountedMap.new_pool(64), CONFIG)
    counted.insert(np.array([[2.05, 0.05]]), SENSOR, np.zeros(3))
    grid = counted.grid()
    assert grid.hits.dtype == grid.passes.dtype == np.uint16
    grid.hits[grid.hits > 0] = MAX_COUNT
    grid.passes[grid.passes > 0] = MAX_COUNT
    counted.insert(np.array([[2.05, 0.05]]), SENSOR, np.zeros(3))
    assert counts_at(counted, 2.05, 0.05)[0] == MAX_COUNT
    assert counts_at(counted, 1.05, 0.02)[1] == MAX_COUNT
