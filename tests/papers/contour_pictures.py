"""Pictures of Li et al. 2016: niches and people in two maps."""

import numpy as np
import numpy.typing as npt
from matplotlib import pyplot as plt

from service.kernels.contours import ALONE
from tests.papers.pictures import draw_likelihood, save

Array = npt.NDArray[np.float64]
Window = tuple[float, float, float, float]


def draw_niches(
    maps: dict[str, Array], xy_m: Array, cell_m: float, window: Window, seed: int
) -> tuple[str, str]:
    """A46 A10: likelihoods of the same cells (N, 2) in each map; the window is x0, x1, y0, y1 in m."""
    caption = f"Likelihood in a corridor with niches, dark is 1, m, seed {seed} (A46, A10)"
    return _stacked("contour-niches.png", maps, xy_m, cell_m, window, caption)


def draw_track(
    name: str, maps: dict[str, Array], xy_m: Array, cell_m: float, window: Window, ids: str, seed: int
) -> tuple[str, str]:
    """A48 A49: the printed update with and without decrease."""
    return _stacked(
        name, maps, xy_m, cell_m, window, f"The printed update, dark is 1, m, seed {seed} ({ids})"
    )


def _stacked(
    name: str, maps: dict[str, Array], xy_m: Array, cell_m: float, window: Window, caption: str
) -> tuple[str, str]:
    figure, axes = plt.subplots(1, len(maps), figsize=(7.6, 2.6), dpi=90, sharey=True)
    for panel, (title, likelihood) in zip(axes, maps.items(), strict=True):
        draw_likelihood(panel, xy_m, likelihood, cell_m, window)
        panel.set_title(title, fontsize=8)
    return save(figure, name, caption)


def rasterise_scan(
    xy_m: Array,
    contour: npt.NDArray[np.int32],
    maps: dict[str, Array],
    cells_m: Array,
    cell_m: float,
    window: Window,
) -> tuple[str, str]:
    """A16 A21: the contours of one scan, points of none grey, and both blurs of it."""
    figure, axes = plt.subplots(1, 1 + len(maps), figsize=(7.6, 2.6), dpi=90, sharey=True)
    alone = contour == ALONE
    axes[0].plot(*xy_m[alone].T, ".", color="0.6", ms=2)
    axes[0].scatter(*xy_m[~alone].T, c=contour[~alone] % 12, cmap="Paired", s=3, linewidths=0)
    axes[0].set_xlim(*window[:2])
    axes[0].set_ylim(*window[2:])
    axes[0].set_aspect("equal")
    axes[0].set_title(f"{contour.max() + 1} contours", fontsize=8)
    axes[0].tick_params(labelsize=7)
    for panel, (title, likelihood) in zip(axes[1:], maps.items(), strict=True):
        draw_likelihood(panel, cells_m, likelihood, cell_m, window)
        panel.set_title(title, fontsize=8)
    return save(figure, "contour-scan.png", "One scan: its contours, and both blurs of them, m (A16, A21)")
