"""Wheels that change their speed faster than a vehicle can: they slip, or it has hit something; [39].

Where a scan leaves the direction of travel open, odometry alone measures the motion along it, and only the
acceleration of the wheels shows that they slip: grip limits that of a vehicle, not that of a wheel which has
lost it. From then on the vehicle may continue at the speed before. The distance between both is an error of
the pose, until scans that fix the position confirm the speed of the wheels, or these return to that before.
"""

import math
from dataclasses import dataclass

import numpy as np

from service.estimator.motion import Matrix
from service.estimator.standstill import MAX_BRAKING_MPS2
from service.geometry.chi2 import CHI2_99999_OF_3
from service.kernels.tracks import SPEED_WINDOW_NS, Track

MAX_WINDOWS_S = 4e-9 * SPEED_WINDOW_NS  # slower odometry shows no jump
USUAL_SAMPLES = 100  # of odometry, over which the usual change of its speed is averaged
COMPARED_S = 0.5  # for which scans fix the position, until they tell whether wheels slip
FIXED_SIGMA_M = 0.1  # of a position that a scan fixes, in its worst direction


@dataclass(slots=True)
class WheelSlip:
    """The speed by which wheels may be wrong. Call `add` with samples, `step` and `compare` with scans."""

    speed_mps: float = 0.0  # of the wheels beyond that of the vehicle; 0: they roll
    _jump_mps: float = 0.0  # largest change of speed, while it is beyond grip
    _usual_m2ps2: float = 0.0  # mean square of the change of speed
    _count: int = 0  # of samples in it, at most USUAL_SAMPLES
    _slipped_m: float = 0.0  # since the wheels began to slip
    _elapsed_s: float = 0.0  # between the last two scans
    # While each scan has fixed the position: time, s, and distance by odometry less that by scans, m.
    _fixed: tuple[float, float] | None = None

    def add(self, track: Track) -> bool:
        """Add the newest sample of odometry; whether wheels begin to slip with it."""
        first, end = track.span.tolist()
        stamps, newest = track.stamp_ns[first:end], end - first - 1
        middle = int(stamps.searchsorted(stamps[newest] - SPEED_WINDOW_NS, "right")) - 1
        oldest = int(stamps.searchsorted(stamps[middle] - SPEED_WINDOW_NS, "right")) - 1
        elapsed_s = int(stamps[newest] - stamps[oldest]) * 1e-9
        if not 0 <= oldest < middle < newest or elapsed_s > MAX_WINDOWS_S:
            return False
        poses = track.value[first:end, :3]
        change_mps = _forward_m(poses, middle, newest) / (int(stamps[newest] - stamps[middle]) * 1e-9)
        change_mps -= _forward_m(poses, oldest, middle) / (int(stamps[middle] - stamps[oldest]) * 1e-9)
        is_usual = change_mps**2 <= CHI2_99999_OF_3 * self._usual_m2ps2
        is_possible = abs(change_mps) <= MAX_BRAKING_MPS2 * 0.5 * elapsed_s
        if not is_usual and not is_possible and self._count == USUAL_SAMPLES:
            self._jump_mps = max(self._jump_mps, change_mps, key=abs)
            return False
        self._count = min(self._count + 1, USUAL_SAMPLES)
        self._usual_m2ps2 += (change_mps**2 - self._usual_m2ps2) / self._count
        if not self._jump_mps:
            return False
        is_return = abs(self.speed_mps + self._jump_mps) < 0.5 * abs(self._jump_mps)
        self.speed_mps = 0.0 if is_return else self.speed_mps + self._jump_mps
        self._slipped_m, self._jump_mps, self._fixed = 0.0, 0.0, None
        return not is_return

    def step(self, elapsed_s: float) -> Matrix | None:
        """(3, 3) covariance, base axes, of a slip since the last scan; None: the wheels roll."""
        self._elapsed_s = elapsed_s
        if not self.speed_mps:
            return None
        before_m, self._slipped_m = self._slipped_m, self._slipped_m + abs(self.speed_mps) * elapsed_s
        return np.diag([self._slipped_m**2 - before_m**2, 0.0, 0.0])

    def compare(self, information: Matrix, apart_m: float) -> None:
        """Take a match.

        information   (3, 3) of the scan alone, base axes
        apart_m       distance forward since the last scan by odometry, less that by scans
        """
        if not self.speed_mps:
            return
        if np.linalg.eigvalsh(information[:2, :2])[0] < 1.0 / FIXED_SIGMA_M**2:
            self._fixed = None
            return
        self._slipped_m = 0.0
        if self._fixed is None:
            self._fixed = 0.0, 0.0
            return
        fixed_s, fixed_m = self._fixed[0] + self._elapsed_s, self._fixed[1] + apart_m
        self._fixed = fixed_s, fixed_m
        if fixed_s >= COMPARED_S:
            self._fixed = 0.0, 0.0
            if abs(fixed_m) < 0.5 * abs(self.speed_mps) * fixed_s:
                self.speed_mps = 0.0


def _forward_m(poses: Matrix, begin: int, end: int) -> float:
    """Distance forward between two rows of poses (N, 3)."""
    x_m, y_m, _ = (poses[end] - poses[begin]).tolist()
    heading_rad = float(poses[begin, 2])
    return float(x_m * math.cos(heading_rad) + y_m * math.sin(heading_rad))
