"""The sweeps of a fake LMS100 as the channels of its scan telegram. No I/O."""

import numpy as np

from drivers.sick_lms100.telegrams import FIRST_RANGE_CODE, Channel, ScanDataConfig
from simulators.device import Sweep

Channels = tuple[Channel, ...]


def channels_of(
    sweep: Sweep, layout: ScanDataConfig, first_e4deg: int, step_e4deg: int, scale: float, reach_m: float
) -> tuple[Channels, Channels]:
    """Channels of 16 and of 8 bits. scale in mm per digit; beyond reach_m there is no echo.

    Where the layout has a second echo, all of it is empty.
    """
    digits = np.nan_to_num(sweep.range_m, nan=0.0) * (1000.0 / scale)
    seen = (digits >= FIRST_RANGE_CODE) & (sweep.range_m <= reach_m)
    first_echo = np.where(seen, np.rint(digits), 0).astype(np.uint16)
    nothing = np.zeros_like(first_echo)
    most = 0xFFFE if layout.remission_16bit else 0xFE
    remission = np.where(seen, np.rint(1 + sweep.intensity * (most - 1)), 0).astype(np.uint16)
    distances: Channels = ()
    remissions: Channels = ()
    for echo, bit in ((1, 1), (2, 2)):
        if layout.echoes & bit:
            values = first_echo if echo == 1 else nothing
            distances += (Channel(f"DIST{echo}", values, first_e4deg, step_e4deg, scale),)
            values = remission if echo == 1 else nothing
            remissions += (Channel(f"RSSI{echo}", values, first_e4deg, step_e4deg, 1.0),)
    if not layout.remission:
        return distances, ()
    if layout.remission_16bit:
        return distances + remissions, ()
    return distances, remissions
