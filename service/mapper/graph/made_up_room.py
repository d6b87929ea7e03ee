"""What a laser sees in a made-up room: for the warm-up of graphs."""

import numpy as np
import numpy.typing as npt

STEP_M = 0.3  # between two key frames
BEAMS = 181


def seen_from(x_m: float) -> tuple[npt.NDArray[np.float32], float]:
    """A room from -3 to 7 m by -2 to 2 m, from (x, 0): returns (BEAMS, 2) m, and rad between two beams."""
    angle = np.linspace(-2.3, 2.3, BEAMS)
    with np.errstate(divide="ignore"):
        to_side = 2.0 / np.abs(np.sin(angle))
        to_end = np.where(np.cos(angle) > 0.0, 7.0 - x_m, 3.0 + x_m) / np.abs(np.cos(angle))
    range_m = np.minimum(to_side, to_end)
    xy = np.column_stack((range_m * np.cos(angle), range_m * np.sin(angle))).astype(np.float32)
    return xy, 4.6 / (BEAMS - 1)
