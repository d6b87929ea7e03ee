"""Spacing of the returns of a scan in beams."""

import numpy as np

from service.kernels.arrays import Int32_1D
from service.kernels.compiled import kernel

MAX_GAP = 64  # beams; returns farther apart are not neighbours


@kernel(Int32_1D)
def usual_gap(beam):
    """Most common gap from one return to the next, in beams; 1 where there is none.

    It is 1 where each beam is measured. A LUX measures every second or fourth direction of the grid that its
    layers are projected to; the directions between are not measured.

    beam   (N,) int32   of each return, rising
    """
    counts = np.zeros(MAX_GAP, np.int64)
    for i in range(1, beam.shape[0]):
        gap = beam[i] - beam[i - 1]
        if gap < MAX_GAP:
            counts[gap] += 1
    most = counts.argmax()
    return most if counts[most] > 0 else 1
