"""Small pictures for the pages of the papers."""

import matplotlib as mpl
import numpy as np
import numpy.typing as npt
from PIL import Image

mpl.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.axes import Axes

from drivers.frames import LaserScan
from service.geometry.poses import moved_by
from service.geometry.se2 import SE2
from tests.papers.report import FOLDER

Array = npt.NDArray[np.float64]
COLOURS = 64


def draw_likelihood(
    panel: Axes, xy_m: Array, likelihood: Array, cell_m: float, window: tuple[float, float, float, float]
) -> None:
    """Cells (N, 2) with their likelihood, dark is 1; x0, x1, y0, y1 in m is what is shown."""
    x0, x1, y0, y1 = window
    bins = round((y1 - y0) / cell_m), round((x1 - x0) / cell_m)
    image, *_ = np.histogram2d(xy_m[:, 1], xy_m[:, 0], bins, ((y0, y1), (x0, x1)), weights=likelihood)
    panel.imshow(
        1.0 - image,
        cmap="gray",
        vmin=0.0,
        vmax=1.0,
        origin="lower",
        extent=window,
        interpolation="antialiased",
    )
    panel.tick_params(labelsize=7)


def end_points(scan: LaserScan, pose: SE2) -> Array:
    """(N, 2) m of a scan whose sensor has this pose, in the frame of the pose."""
    angle = scan.first_angle_rad + scan.angle_step_rad * np.arange(len(scan.range_m))
    seen = np.isfinite(scan.range_m)
    xy = (scan.range_m * np.stack([np.cos(angle), np.sin(angle)]))[:, seen].T.astype(float)
    return moved_by(pose, xy)


def draw_scale(panel: Axes, length_m: float) -> None:
    """A bar of this length below all that the panel shows."""
    x0, x1, y0, y1 = panel.axis()
    low = y0 - 0.08 * (y1 - y0)
    panel.set_ylim(low - 0.06 * (y1 - y0), y1)
    left = x0 + 0.05 * (x1 - x0)
    panel.plot([left, left + length_m], [low, low], "k-", lw=3, solid_capstyle="butt")
    panel.text(left + length_m, low, f" {length_m:g} m", fontsize=8, va="center")


def save(figure: plt.Figure, name: str, caption: str) -> tuple[str, str]:
    """Writes a PNG of few colours into FOLDER; gives its name and caption. Raises OSError."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    figure.tight_layout()
    figure.canvas.draw()
    pixels = np.asarray(figure.canvas.buffer_rgba())[..., :3]  # type: ignore[attr-defined]
    plt.close(figure)
    Image.fromarray(np.ascontiguousarray(pixels)).quantize(COLOURS, Image.Quantize.MAXCOVERAGE).save(
        FOLDER / name, optimize=True
    )
    return name, caption
