"""Pictures of Qian et al. 2019: segments of one scan, both maps, and the map over the surveyed building."""

import numpy as np
import numpy.typing as npt
from matplotlib import pyplot as plt

from service.kernels.blurred_segments import NO_SEGMENT
from tests.papers.pictures import draw_likelihood, save

Array = npt.NDArray[np.float64]
LIKELY = 0.5  # cells from here on are shown over the building


def draw_segments(xy_m: Array, segment: npt.NDArray[np.int32]) -> tuple[str, str]:
    """B23: end points of a scan in the axes of the map, and which of them lie in segments."""
    figure, panel = plt.subplots(figsize=(6.4, 4.0), dpi=90)
    kinds = (
        ("in none", (segment == NO_SEGMENT).all(axis=1), "0.6"),
        ("along x", segment[:, 0] != NO_SEGMENT, "tab:blue"),
        ("along y", segment[:, 1] != NO_SEGMENT, "tab:red"),
    )
    for name, chosen, colour in kinds:
        panel.plot(*xy_m[chosen].T, ".", color=colour, ms=2.5, label=f"{name}: {chosen.sum()}")
    panel.set_aspect("equal")
    panel.tick_params(labelsize=7)
    panel.legend(fontsize=7)
    return save(
        figure, "owolm-segments.png", "Orthogonal blurred segments of one scan in the library, m (B23)"
    )


def draw_maps(
    maps: dict[str, tuple[Array, Array]], cell_m: float, window: tuple[float, float, float, float], seed: int
) -> tuple[str, str]:
    """B28: the same part of each map; x0, x1, y0, y1 in m."""
    figure, axes = plt.subplots(1, len(maps), figsize=(7.2, 3.6), dpi=90, sharey=True)
    for panel, (name, (xy_m, likelihood)) in zip(axes, maps.items(), strict=True):
        draw_likelihood(panel, xy_m, likelihood, cell_m, window)
        panel.set_title(name, fontsize=8)
    caption = f"Bookcases, and the glass cabinet below them, in both maps, m, seed {seed} (B28)"
    return save(figure, "owolm-maps.png", caption)


def draw_overlay(
    xy_m: Array, likelihood: Array, structure: Array, points: Array, seed: int
) -> tuple[str, str]:
    """B34: the map, the surveyed walls, crosses and numbers at the check points."""
    figure, panel = plt.subplots(figsize=(7.2, 4.9), dpi=90)
    panel.plot(*xy_m[likelihood > LIKELY].T, ",", color="red")
    for x0, y0, x1, y1 in structure:
        panel.plot((x0, x1), (y0, y1), "-", color="blue", lw=0.5)
    for number, (x, y) in enumerate(points, start=1):
        panel.plot(x, y, "k+", ms=8)
        panel.annotate(str(number), (x, y), (4, 4), textcoords="offset points", fontsize=8)
    panel.set_aspect("equal")
    panel.tick_params(labelsize=7)
    caption = (
        f"The map (red) fitted to the true building (blue), and the 18 check points, m, seed {seed} (B34)"
    )
    return save(figure, "owolm-overlay.png", caption)
