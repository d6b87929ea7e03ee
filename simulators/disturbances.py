"""Disturbances of a drive's measurements for a time: slip of the wheels, a turned laser.

Times are those of the drive, seconds since it began.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from simulators.trajectory import Floats, Trajectory


@dataclass(frozen=True, slots=True)
class Slip:
    """The wheels' travel by the vehicle's: 0 blocked (towed, carried), above 1 spinning."""

    from_s: float
    to_s: float
    path_scale: float = 0.0
    turn_scale: float = 0.0

    def scales(self, time_s: float) -> tuple[float, float]:
        """Of distance and turn, at that time."""
        return (self.path_scale, self.turn_scale) if self.from_s <= time_s < self.to_s else (1.0, 1.0)


@dataclass(frozen=True, slots=True)
class Knock:
    """The laser is turned by this angle against its mounting; counter-clockwise."""

    from_s: float
    to_s: float
    yaw_rad: float

    def acts(self, time_s: Floats) -> npt.NDArray[np.bool_]:
        acting: npt.NDArray[np.bool_] = (time_s >= self.from_s) & (time_s < self.to_s)
        return acting


def rolled(drive: Trajectory, slips: Sequence[Slip], time_s: Floats) -> Floats:
    """(N, 2) distance m and turn rad that the wheels have rolled since the drive began."""
    travel = drive.travel(time_s)
    for slip in slips:
        begun = drive.travel(np.array([slip.from_s]))
        missed = 1.0 - np.array([slip.path_scale, slip.turn_scale])
        travel -= missed * (drive.travel(np.clip(time_s, slip.from_s, slip.to_s)) - begun)
    return travel
