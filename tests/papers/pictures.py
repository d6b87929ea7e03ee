"""Small pictures for the pages of the papers."""

import matplotlib as mpl
import numpy as np
import numpy.typing as npt
from PIL import Image

mpl.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.axes import Axes

from tests.papers.report import FOLDER

Array = npt.NDArray[np.float64]
COLOURS = 24


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


def save(figure: plt.Figure, name: str, caption: str) -> tuple[str, str]:
    """Writes a PNG of few colours into docs/papers/; gives its name and caption. Raises OSError."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    figure.tight_layout()
    figure.canvas.draw()
    pixels = np.asarray(figure.canvas.buffer_rgba())[..., :3]  # type: ignore[attr-defined]
    plt.close(figure)
    Image.fromarray(np.ascontiguousarray(pixels)).quantize(COLOURS, Image.Quantize.MAXCOVERAGE).save(
        FOLDER / name, optimize=True
    )
    return name, caption
