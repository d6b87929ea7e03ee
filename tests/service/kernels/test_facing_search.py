import math

import numpy as np
import pytest

from service.kernels import facing_search
from service.kernels.facing_search import (
    LAYERS,
    NATS_STEP,
    SECTORS,
    FacingPyramid,
    search_facing,
    splat_facing,
)
from tests.service.kernels.inner import from_python

facing_sum = from_python(facing_search.facing_sum)
turned_facing = from_python(facing_search.turned_facing)

CELL_M, LEVELS, HEADINGS = 0.2, 4, 24
BLOCK = 1 << (LEVELS - 1)
SIGMA_M = 0.12


def room(turn_rad: float = 0.0, width_m: float = 5.0) -> tuple[np.ndarray, np.ndarray]:
    """Walls of a room of 3 m by its width seen from within, with a niche that distinguishes its ends."""
    xy, normals = [], []
    for begin, end in (
        ((0.0, 0.0), (width_m, 0.0)),
        ((width_m, 0.0), (width_m, 3.0)),
        ((width_m, 3.0), (1.0, 3.0)),
        ((1.0, 3.0), (1.0, 2.0)),
        ((1.0, 2.0), (0.0, 2.0)),
        ((0.0, 2.0), (0.0, 0.0)),
    ):
        direction = np.subtract(end, begin)
        length_m = float(np.hypot(*direction))
        inward = np.array([-direction[1], direction[0]]) / length_m
        for share in np.arange(0.05, length_m, 0.1) / length_m:
            xy.append(np.array(begin) + share * direction)
            normals.append([*inward, 1.0])
    c, s = math.cos(turn_rad), math.sin(turn_rad)
    turn = np.array([[c, -s], [s, c]])
    faces = np.array(normals)
    faces[:, :2] = faces[:, :2] @ turn.T
    return np.array(xy) @ turn.T, faces


def pyramid_of(xy: np.ndarray, normals: np.ndarray) -> FacingPyramid:
    low = np.floor(xy.min(axis=0) / CELL_M).astype(int) - 1 - BLOCK
    high = np.floor(xy.max(axis=0) / CELL_M).astype(int) + 2 + BLOCK
    columns, rows = (-(-(high - low) // BLOCK) * BLOCK).tolist()
    levels = np.empty((LAYERS, LEVELS, rows, columns), np.int8)
    pyramid = FacingPyramid(levels, int(low[1]), int(low[0]), CELL_M)
    splat_facing(xy, normals, np.zeros((rows, columns), np.bool_), pyramid, SIGMA_M)
    return pyramid


def seen_from(xy: np.ndarray, normals: np.ndarray, pose: tuple[float, float, float]) -> tuple:
    """Points and normals in the frame of a base with a pose in theirs."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    turn = np.array([[c, -s], [s, c]])
    faces = normals.copy()
    faces[:, :2] = normals[:, :2] @ turn
    return np.ascontiguousarray((xy - pose[:2]) @ turn), faces


def asked_one_by_one(xy, normals, pyramid) -> dict[tuple[int, int], float]:
    """The best score of each block and sector, by asking every heading and cell."""
    rows, columns = pyramid.levels.shape[2:]
    best: dict[tuple[int, int], float] = {}
    cells = np.empty((len(xy), 3), np.int64)
    for k in range(HEADINGS):
        turned_facing(xy, normals, 2.0 * math.pi * k / HEADINGS, CELL_M, cells)
        for row in range(rows):
            for column in range(columns):
                own = (row // BLOCK * (columns // BLOCK) + column // BLOCK, k * SECTORS // HEADINGS)
                score = facing_sum(cells, pyramid.levels, 0, row, column, -(10**9)) * NATS_STEP / len(xy)
                best[own] = max(best.get(own, 0.0), score)
    return best


@pytest.mark.parametrize("least", [0.5, 0.9])
def test_each_block_and_sector_gives_the_place_that_asking_all_gives(least):
    xy, normals = room()
    pyramid = pyramid_of(xy, normals)
    there = seen_from(xy[::3], normals[::3], (2.1, 1.3, 0.5))
    places, evaluated = search_facing(*there, pyramid, HEADINGS, least)
    expected = asked_one_by_one(*there, pyramid)
    wanted = sorted(nats for nats in expected.values() if nats > least + 1e-3)
    assert len(wanted) > 1
    found = sorted(places[:, 3])
    np.testing.assert_allclose(found[len(found) - len(wanted) :], wanted, atol=1e-9)
    assert evaluated < HEADINGS * pyramid.levels.shape[2] * pyramid.levels.shape[3]


def test_the_best_place_is_where_the_scan_was_taken():
    xy, normals = room()
    pose = (1.7, 0.9, 2.0 * math.pi * 7 / HEADINGS)
    places, _ = search_facing(*seen_from(xy, normals, pose), pyramid_of(xy, normals), HEADINGS, 0.5)
    best = places[np.argmax(places[:, 3])]
    assert abs(best[0] - pose[0]) <= CELL_M
    assert abs(best[1] - pose[1]) <= CELL_M
    assert best[2] == pytest.approx(pose[2])


def test_a_wall_is_not_found_from_its_other_side():
    xy = np.column_stack((np.arange(0.0, 4.0, 0.1), np.zeros(40)))
    above = np.tile([0.0, 1.0, 1.0], (40, 1))
    pyramid = pyramid_of(xy, above)
    below = above * (1.0, -1.0, 1.0)
    turned_by_no_heading = 1  # of one: only the given heading
    assert len(search_facing(xy, above, pyramid, turned_by_no_heading, 1.5)[0]) > 0
    assert len(search_facing(xy, below, pyramid, turned_by_no_heading, 0.3)[0]) == 0
