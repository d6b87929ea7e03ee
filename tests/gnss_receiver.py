"""A satellite receiver: where it finds its antenna, with errors that last.

Errors of one receiver change within a minute or so. They are a Gauss-Markov process besides noise of a few
centimetres; and where walls reflect what should be in their shadow, an offset that comes and goes at once.
Source of the shape: Groves, Principles of GNSS, inertial, and multisensor integrated navigation, 2013,
chapter 9; of the size: u-blox 6 data sheet, 2.5 m circular error probable.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from drivers.frames import GnssFix
from service.geometry.geo_reference import LocalFrame
from service.geometry.se2 import SE2
from simulators.truth import noise_of

STEP_S = 1.0  # the lasting error is sampled at these steps, straight between them


@dataclass(frozen=True, slots=True)
class Reflection:
    """From begin_s to end_s every fix is off by this without any sign of it."""

    begin_s: float
    end_s: float
    east_m: float
    north_m: float


@dataclass(frozen=True, slots=True)
class GnssModel:
    """lasting_sigma_m, noise_sigma_m: each axis. reported_sigma_m is what the receiver claims."""

    rate_hz: float = 4.0
    lasting_sigma_m: float = 1.5
    correlation_s: float = 45.0
    noise_sigma_m: float = 0.05
    reported_sigma_m: float = 2.0
    height_sigma: float = 1.5  # times the error in the plane
    delay_s: float = 0.1  # from measuring to arriving
    reflections: Sequence[Reflection] = ()
    outages: Sequence[tuple[float, float]] = ()  # s: no fix from the first to the second


@dataclass
class Receiver:
    """One receiver on a ride.

    origin         where the frame of the world lies on the earth
    world_yaw_rad  of the world's x axis against east, counter-clockwise
    """

    model: GnssModel
    seed: int
    origin: LocalFrame = field(default_factory=lambda: LocalFrame(60.161, 24.546, 51.7))
    world_yaw_rad: float = 0.0

    def __post_init__(self) -> None:
        self._noise = noise_of(self.seed, "gnss lasting", 0)
        self._lasting = [self.model.lasting_sigma_m * self._noise.standard_normal(3)]

    @property
    def period_ns(self) -> int:
        return round(1e9 / self.model.rate_hz)

    def fix(self, sensor: str, stamp_ns: int, antenna_world: tuple[float, float]) -> GnssFix:
        """stamp_ns counts from the beginning of the ride; antenna_world in m."""
        time_s = stamp_ns * 1e-9
        arrived_ns = stamp_ns + round(self.model.delay_s * 1e9)
        if any(begin <= time_s < end for begin, end in self.model.outages):
            nan = math.nan
            return GnssFix(sensor, stamp_ns, arrived_ns, -1, nan, nan, nan, (0.0,) * 9)
        at = SE2(0.0, 0.0, self.world_yaw_rad) @ SE2(*antenna_world)
        off = self._lasting_error(time_s)
        off += self.model.noise_sigma_m * noise_of(self.seed, "gnss", stamp_ns).standard_normal(3)
        for reflection in self.model.reflections:
            if reflection.begin_s <= time_s < reflection.end_s:
                off[:2] += reflection.east_m, reflection.north_m
        up_m = -(at.x_m**2 + at.y_m**2) / (2.0 * 6_378_137.0) + self.model.height_sigma * off[2]
        latitude_deg, longitude_deg, height_m = self.origin.from_enu(
            np.array([at.x_m + off[0], at.y_m + off[1], up_m])
        )
        plane, up = (
            self.model.reported_sigma_m**2,
            (self.model.height_sigma * self.model.reported_sigma_m) ** 2,
        )
        return GnssFix(
            sensor,
            stamp_ns,
            arrived_ns,
            0,
            round(latitude_deg, 7),
            round(longitude_deg, 7),
            round(height_m, 3),
            (plane, 0.0, 0.0, 0.0, plane, 0.0, 0.0, 0.0, up),
        )

    def _lasting_error(self, time_s: float) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
        """(3,) m; the same for one time, independent of earlier calls."""
        k, share = divmod(max(time_s, 0.0) / STEP_S, 1.0)
        keep = math.exp(-STEP_S / self.model.correlation_s)
        new_sigma_m = self.model.lasting_sigma_m * math.sqrt(1.0 - keep * keep)
        while len(self._lasting) < k + 2:
            self._lasting.append(keep * self._lasting[-1] + new_sigma_m * self._noise.standard_normal(3))
        before, after = self._lasting[int(k)], self._lasting[int(k) + 1]
        return before + share * (after - before)
