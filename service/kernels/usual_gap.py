"""How far apart the returns of a scan are, where they are neighbours."""

import numpy as np

from service.kernels.arrays import Int32_1D
from service.kernels.compiled import kernel

MAX_GAP = 64  # beams; returns farther apart are no neighbours


@kernel(Int32_1D)
def usual_gap(beam):
    """From one return to the next, in beams, where they are neighbours: the most common gap; 1 where none is.

    It is 1 where each beam is measured. A LUX measures each second or fourth direction of the grid that its
    layers are reduced to: what lies between is not looked at, and no gap in what stands there.

    beam   (N,) int32   of each return, rising
    """
    counts = np.zeros(MAX_GAP, np.int64)
    for i in range(1, beam.shape[0]):
        gap = beam[i] - beam[i - 1]
        if gap < MAX_GAP:
            counts[gap] += 1
    most = counts.argmax()
    return most if counts[most] > 0 else 1
