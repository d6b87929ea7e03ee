import math

import numpy as np
import pytest

from service.kernels import counted_occupancy, tiles
from service.kernels.counted_occupancy import MAX_COUNT, CountWeights, count_overlap, weigh_scan
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


def test_cells_that_beams_cross_are_those_of_a_dense_walk() -> None:
    rng = np.random.default_rng(2)
    ends = rng.uniform(-4.0, 4.0, (40, 2))
    pose = np.array([-3.3, 7.1, 0.7])
    counted = CountedMap(CountedMap.new_pool(64), CONFIG)
    counted.insert(ends, np.array([0.2, 0.1]), pose)
    c, s = math.cos(0.7), math.sin(0.7)
    world = ends @ np.array([[c, s], [-s, c]]) + pose[:2]
    start = np.array([0.2, 0.1]) @ np.array([[c, s], [-s, c]]) + pose[:2]
    hit = {tuple(cell) for cell in np.floor(world / 0.1).astype(int)}
    for end in world:
        for share in np.linspace(0.0, 0.999, 60):
            x, y = start + share * (end - start)
            if math.dist(start, (x, y)) > 4.9 or tuple(np.floor(np.array([x, y]) / 0.1).astype(int)) in hit:
                continue
            if math.dist((x, y), end) > 0.15:
                assert counts_at(counted, x, y)[:2] == (0, 1)
    assert all(counts_at(counted, *end)[0] == 1 for end in world)


def test_a_scan_weighs_the_sum_of_its_logarithms() -> None:
    values = np.array([[0.9, 0, 0], [0.5, 0, 0]])
    total, mean = weigh_scan(values, 0.1)
    assert total == pytest.approx(math.log(0.1 + 0.9 * 0.9) + math.log(0.1 + 0.9 * 0.5))
    assert mean == pytest.approx(0.7)


def test_count_scan_asks_only_every_so_many_beams_to_clear() -> None:
    counted = CountedMap(CountedMap.new_pool(64), CONFIG)
    ends = np.array([[2.05, 0.05], [0.05, 2.05]])
    counted.insert(ends, SENSOR, np.zeros(3))
    sparse = CountedMap(CountedMap.new_pool(64), CONFIG.model_copy(update={"pass_stride": 2}))
    sparse.insert(ends, SENSOR, np.zeros(3))
    assert counts_at(counted, 0.02, 1.05)[:2] == (0, 1)
    assert counts_at(sparse, 0.02, 1.05)[:2] == (0, 0)
    assert counts_at(sparse, 0.05, 2.05)[:2] == (1, 0)


def test_a_point_lies_on_a_wall_in_the_free_or_on_ground_no_one_saw() -> None:
    counted = CountedMap(CountedMap.new_pool(64), CONFIG)
    counted.insert(np.array([[2.05, 0.05]]), SENSOR, np.zeros(3))
    xy = np.array([[2.05, 0.05], [2.15, 0.15], [2.25, 0.05], [1.05, 0.05], [1.85, 0.05], [1.0, 1.0]])
    assert count_overlap(xy, np.zeros(3), counted.grid(), 1) == (2, 2)
    assert count_overlap(xy, np.zeros(3), counted.grid(), 2) == (4, 1)
    assert count_overlap(xy, np.array([50.0, 0.0, 0.0]), counted.grid(), 1) == (0, 0)
