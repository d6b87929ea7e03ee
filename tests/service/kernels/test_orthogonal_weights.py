import numpy as np
import pytest
from scipy.stats import norm

from service.kernels.orthogonal_weights import NOISY_OR, WeightedLayer, insert_weighted
from service.kernels.surfels import TILE_BITS, TILE_CELLS
from tests.service.kernels.grids import empty_tiles

CELL_M = 0.1
SIGMAS = np.array([[1.5, 1.5], [1.5, 0.5], [0.5, 1.5], [0.5, 0.5]])
ALONE = np.array([[-1, -1]], np.int32)


def empty_layer():
    shape = (16, TILE_CELLS, TILE_CELLS)
    return WeightedLayer(empty_tiles(), np.zeros(shape, np.float32), np.zeros(shape, np.uint8), CELL_M)


def cell(layer, row, column):
    slot = layer.tiles.slots[(row >> TILE_BITS) + 2, (column >> TILE_BITS) + 2]
    return float(layer.likelihood[slot, row % TILE_CELLS, column % TILE_CELLS])


def block(layer, row, column):
    return np.array([[cell(layer, row + a, column + b) for b in (-1, 0, 1)] for a in (-1, 0, 1)])


@pytest.mark.parametrize("about_point", [True, False])
def test_a_point_is_blurred_into_nine_cells(about_point):  # B24 B25
    layer = empty_layer()
    insert_weighted(np.array([[0.58, -0.23]]), ALONE, SIGMAS, about_point, NOISY_OR, layer)
    mean = (0.3, 0.2) if about_point else (0.0, 0.0)  # (0.58, -0.23) from the centre (0.55, -0.25), in cells
    along_x, along_y = (np.diff(norm.cdf([-1.5, -0.5, 0.5, 1.5], m, 1.5)) for m in mean)
    np.testing.assert_allclose(block(layer, -3, 5), np.outer(along_y, along_x), rtol=1e-6)
    assert block(layer, -3, 5).sum() <= 1.0
    assert layer.likelihood.sum() == pytest.approx(block(layer, -3, 5).sum())


def test_points_in_segments_are_narrower_and_weigh_more():  # B26 B27
    heights = {}
    for name, segment in {"none": (-1, -1), "along x": (0, -1), "along y": (-1, 2), "both": (1, 1)}.items():
        layer = empty_layer()
        insert_weighted(
            np.array([[0.55, 0.55]]), np.array([segment], np.int32), SIGMAS, True, NOISY_OR, layer
        )
        heights[name] = block(layer, 5, 5)
    assert heights["none"][1, 1] > 0.05  # still enters
    assert heights["both"][1, 1] > 6.0 * heights["none"][1, 1]
    assert heights["along x"][0, 1] < heights["along x"][1, 0]  # narrow across the wall, in y
    np.testing.assert_allclose(heights["along x"], heights["along y"].T)


def test_noisy_or_only_rises_and_never_passes_one():  # B25
    layer = empty_layer()
    point = np.array([[0.52, 0.55]])
    before = 0.0
    expected = 0.0
    single = None
    for _ in range(200):
        insert_weighted(point, ALONE, SIGMAS, True, NOISY_OR, layer)
        after = cell(layer, 5, 5)
        single = after if single is None else single
        expected = 1.0 - (1.0 - expected) * (1.0 - single)
        assert before <= after <= 1.0
        assert after == pytest.approx(expected, abs=1e-4)
        before = after
    assert before > 0.99
