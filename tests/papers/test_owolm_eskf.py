"""How a map is aligned with the true check points."""

import numpy as np

from simulators.worlds.library import library_structure
from tests.papers.owolm_eskf import _fitted, _turned_by, far_share

APART_M = 0.05


def test_a_map_of_the_structure_moved_and_turned_lies_on_it_again() -> None:
    lines = library_structure()
    counts = np.ceil(np.hypot(*(lines[:, 2:] - lines[:, :2]).T) / APART_M).astype(int)
    true = np.concatenate(
        [np.linspace(line[:2], line[2:], count + 1) for line, count in zip(lines, counts, strict=True)]
    )
    moved = _turned_by(true, 0.005) + np.array([0.06, -0.08])
    assert far_share(moved, np.ones(len(moved))) > 0.25
    aligned = _fitted(moved, np.ones(len(moved)))
    assert aligned.far_share == 0.0
    assert np.nanmedian(aligned.residuals_m) < 0.01
