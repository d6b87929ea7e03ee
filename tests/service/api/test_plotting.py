import sys

import numpy as np
import pytest
from matplotlib.figure import Figure

import corridor
from service.outputs import UNKNOWN


def test_a_plot_shows_map_and_trajectory_in_metres(replayed):
    axes = Figure().add_subplot()
    assert replayed.plot(axes) is axes
    (image,) = axes.get_images()
    grid = replayed.map
    assert image.get_extent()[:1] + image.get_extent()[2:3] == [grid.x_min_m, grid.y_min_m]
    np.testing.assert_array_equal(image.get_array().mask, grid.cells == UNKNOWN)
    shown = np.concatenate([line.get_xydata() for line in axes.get_lines()])
    assert sorted(map(tuple, shown)) == sorted(map(tuple, replayed.trajectory.pose[:, :2]))
    assert [line.get_label() for line in axes.get_lines()] == [
        state for state in ("ok", "degraded", "lost") if replayed.summary["state"][state]
    ]


def test_a_plot_without_matplotlib_says_what_to_install(replayed, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(corridor.CorridorError, match=r"-m pip install 'matplotlib>="):
        replayed.plot()
