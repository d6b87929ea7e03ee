"""Patches of the likelihood map: which are in memory, and that none is lost."""

from dataclasses import replace

import numpy as np
import pytest

from drivers.frames import NO_INTENSITY, LaserScan
from service.estimator.motion import Motion
from service.geometry.se2 import SE2
from service.kernels import line_likelihood
from service.mapper.components import Match, Points
from service.mapper.papers.imle.patch_map import PatchMap, PatchMapConfig
from service.mapper.patch_store import MemoryPatches
from tests.service.kernels.inner import from_python

mean_value = from_python(line_likelihood.mean_value)

CONFIG = PatchMapConfig(cell_m=0.02, patch_cells=200, resident_patches=16, ahead_m=1.0)  # patches of 4 m


class CountingStore(MemoryPatches):
    def __init__(self) -> None:
        super().__init__()
        self.saved: list[tuple[int, int]] = []

    def save(self, key, layers) -> None:
        self.saved.append(key)
        super().save(key, layers)


def circle(radius_m: float = 1.5, count: int = 200) -> Points:
    angle = np.linspace(-3.1, 3.1, count)
    xy = radius_m * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    ranges = np.full(count, radius_m, np.float32)
    scan = LaserScan("front", 0, 0, 0, 1, -3.1, 6.2 / (count - 1), 0.0, 20.0, ranges, NO_INTENSITY)
    return Points(xy, xy, np.zeros(count), np.arange(count, dtype=np.int32), SE2(), scan)


def insert(patches: PatchMap, x_m: float, state: str = "ok") -> None:
    motion = Motion(SE2(x_m, 0.0, 0.0), (0.0, 0.0, 0.0), np.eye(3))
    patches.insert(circle(), Match(motion, circle(), 1.0, state))


def cells_of(patches: PatchMap, key: tuple[int, int]) -> np.ndarray:
    layer = patches.fine
    row, column = np.subtract(key, layer.tiles.origin)
    return layer.cells[layer.tiles.slots[row, column]]


# C13
def test_no_more_patches_stay_in_memory_than_are_allowed_and_none_is_lost() -> None:
    store = CountingStore()
    patches = PatchMap(CONFIG, lambda: store)
    insert(patches, 2.0)
    first = patches.resident
    before = {key: cells_of(patches, key).copy() for key in first}
    for x_m in np.arange(6.0, 80.0, 2.0):
        insert(patches, float(x_m))
        assert len(patches.resident) <= 16
    assert len(patches.fine.cells) == 16
    assert not set(first) & set(patches.resident)
    assert set(first) <= set(store.saved)
    patches.prepare(circle().xy_base + np.array([2.0, 0.0]), 0.1)
    for key, cells in before.items():
        assert (cells_of(patches, key) >= cells).all()
        assert cells.any()


# C26
def test_a_scan_is_inserted_after_some_distance_or_turn_and_not_before() -> None:
    patches = PatchMap(PatchMapConfig(), MemoryPatches)
    inserted = []
    for x_m, theta_rad in ((0.0, 0.0), (0.1, 0.0), (0.19, 0.09), (0.21, 0.0), (0.21, 0.11)):
        motion = Motion(SE2(x_m, 0.0, theta_rad), (0.0, 0.0, 0.0), np.eye(3))
        inserted.append(patches.insert(circle(), Match(motion, circle(), 1.0)).is_keyframe)
    assert inserted == [True, False, False, True, True]
    patches.start_over()
    assert patches.insert(circle(), Match(motion, circle(), 1.0)).is_keyframe


# C10
def test_a_line_that_cuts_off_the_corner_of_a_patch_is_inserted_there_too() -> None:
    """Neither end lies in the patch nor near it: 6 m of wall seen aslant from 34 m away."""
    patches = PatchMap(PatchMapConfig(), MemoryPatches)
    xy = np.array([[27.0, 31.5], [31.5, 27.0]])
    scan = replace(circle().scan, angle_step_rad=0.01)
    points = Points(xy, xy, np.zeros(2), np.arange(2, dtype=np.int32), SE2(), scan)
    patches.insert(points, Match(Motion(SE2(), (0.0, 0.0, 0.0), np.eye(3)), points, 1.0))
    assert set(patches.resident) == {(2, 2), (3, 2), (2, 3)}
    for layer in (patches.fine, patches.coarse):
        for xy_m in ([29.255, 29.245], [27.755, 30.745], [30.745, 27.755]):
            there = mean_value(np.array([xy_m]), np.zeros(3), layer)
            assert there >= patches.levels[1]  # hit, or beside the line by a cell


# C1 C9
@pytest.mark.parametrize(("score", "meaning"), [("product", np.log), ("mean", lambda value: value)])
def test_the_bytes_of_a_cell_stand_for_the_likelihoods_of_the_paper(score, meaning) -> None:
    patches = PatchMap(PatchMapConfig(score=score), MemoryPatches)
    layer = patches.fine
    values = layer.offset + layer.scale * np.array([*patches.levels, layer.empty])
    np.testing.assert_allclose(values, meaning(np.array([0.9, 0.6, 0.3, 0.1])), atol=2e-3)


# C14 C15
def test_a_patch_of_ten_metres_takes_a_megabyte_and_its_coarse_layer_forty_kilobytes() -> None:
    config = PatchMapConfig()
    patches = PatchMap(config, MemoryPatches)
    assert config.patch_m == pytest.approx(10.0)
    assert patches.fine.cells[0].nbytes == 1_000_000
    assert patches.coarse.cells[0].nbytes == 40_000
    assert (patches.fine.cell_m, patches.coarse.cell_m) == (0.01, 0.05)
    assert 80 / config.patch_m * patches.fine.cells.shape[1] == pytest.approx(8000)


# C31
def test_what_lies_ahead_is_fetched_before_it_is_needed() -> None:
    patches = PatchMap(CONFIG, MemoryPatches)
    for x_m in np.arange(2.0, 60.0):
        insert(patches, float(x_m))
    for x_m in np.arange(60.0, 20.0, -0.25):
        before = set(patches.resident)
        patches.prepare(circle().xy_base + np.array([x_m, 0.0]), 3 * CONFIG.coarse_cell_m)
        assert set(patches.resident) == before
        insert(patches, float(x_m))


# C13
def test_the_patch_used_longest_ago_goes_first() -> None:
    """So those of a place that is come back to stay."""
    store = CountingStore()
    patches = PatchMap(CONFIG, lambda: store)
    insert(patches, 2.0)
    often = set(patches.resident)
    for x_m in np.arange(8.0, 60.0, 2.0):
        insert(patches, float(x_m))
        insert(patches, 2.0)
    assert len(store.saved) > 5
    assert not often & set(store.saved)
