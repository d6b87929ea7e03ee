"""Check of the stamps of several lasers against each other, by the rotation that each of them sees.

Late stamps show the vehicle at an earlier heading, which rotates the map back and forth in turns although
half of the scans fit it. With theta(t) the heading by the scans of another laser, a scan of stamp t that is
late by d has the heading theta(t - d), an error of c - d omega with rate of turn omega and mounting error c.
Both follow from a linear regression over the scans (Qin, Shen: Online temporal calibration for monocular
visual-inertial systems, IROS 2018, for the model).
"""

import math
from collections import deque

import numpy as np
import numpy.typing as npt

from service.geometry.chi2 import CHI2_999_OF_1
from service.geometry.se2 import wrap_angle
from service.outputs import NO_REASON, Reason

MAX_SCAN_GAP_NS = 400_000_000  # between two scans, within which the rate of turn counts as constant
MIN_NOISE_RAD = 1e-3  # of a heading by a scan; the excess is estimated
SCANS = 400  # the newest are used
BATCH = 25  # scans, or steps, between two evaluations of a check
SCANS_WITH_SAME_ERRORS = 20.0  # scans with correlated errors, from the same part of the map
TOLERANCE_S = 0.005  # of configured latencies
KNOWN_S = 0.002  # sigma below which consistent stamps clear a fault


class StampCheck:
    """Check of one laser against another. `late_s` is 0 while their stamps agree."""

    def __init__(self) -> None:
        self.late_s = 0.0  # stamps of the one behind those of the other, where they disagree
        self.sigma_s = 0.0
        self._other: tuple[int, float] | None = None  # newest scan of the other laser: stamp, heading
        self._waiting: list[tuple[int, float]] = []  # scans of the one since then
        self._scans: deque[tuple[float, float]] = deque(maxlen=SCANS)  # rate of turn, error of the heading
        self._new = 0

    def add(self, stamp_ns: int, heading_rad: float) -> None:
        """Add a matched scan of the laser."""
        if self._other is not None and stamp_ns - self._other[0] <= MAX_SCAN_GAP_NS:
            self._waiting.append((stamp_ns, heading_rad))

    def add_other(self, stamp_ns: int, heading_rad: float) -> None:
        """Add a matched scan of the other laser, in the order of stamps."""
        before, self._other = self._other, (stamp_ns, heading_rad)
        waiting, self._waiting = self._waiting, []
        if before is None or stamp_ns - before[0] > MAX_SCAN_GAP_NS:
            return
        rate_radps = wrap_angle(heading_rad - before[1]) / ((stamp_ns - before[0]) * 1e-9)
        for at_ns, of_rad in waiting:
            off_rad = wrap_angle(of_rad - before[1]) - rate_radps * (at_ns - before[0]) * 1e-9
            self._scans.append((rate_radps, off_rad))
            self._new += 1
        if self._new >= BATCH:
            self._new = 0
            self._judge()

    def interrupt(self) -> None:
        """Discard waiting scans after the pose was lost."""
        self._other = None
        self._waiting = []

    def _judge(self) -> None:
        late_s, sigma_s = lag_of(np.array(self._scans))
        if late_s**2 > CHI2_999_OF_1 * (sigma_s**2 + TOLERANCE_S**2):
            self.late_s, self.sigma_s = late_s, sigma_s
        elif sigma_s <= KNOWN_S:
            self.late_s = 0.0


def lag_of(scans: npt.NDArray[np.float64]) -> tuple[float, float]:
    """Lag of stamps, s, and its sigma, inf where the vehicle did not turn.

    scans   (K, 2) rad/s, rad   rate of turn, and error of the heading

    The sigma allows for noise that differs between turns and straight paths. Source: White, A
    heteroskedasticity-consistent covariance matrix estimator, Econometrica 48, 1980.
    """
    rate, off = (scans - scans.mean(axis=0)).T
    spread = float(rate @ rate)
    if spread == 0.0:
        return 0.0, math.inf
    slope = float(rate @ off) / spread
    noise = (off - slope * rate) ** 2 + MIN_NOISE_RAD**2
    return -slope, math.sqrt(SCANS_WITH_SAME_ERRORS * float(rate**2 @ noise)) / spread


class StampChecks:
    """Checks of all lasers against the one that began the map."""

    def __init__(self) -> None:
        self.first: str | None = None
        self._checks: dict[str, StampCheck] = {}

    def add(self, sensor: str, stamp_ns: int, heading_rad: float) -> None:
        """Add the heading of a matched scan at the time of its deskewed points; by rising stamps."""
        if self.first is None:
            self.first = sensor
        if sensor != self.first:
            self._checks.setdefault(sensor, StampCheck()).add(stamp_ns, heading_rad)
            return
        for check in self._checks.values():
            check.add_other(stamp_ns, heading_rad)

    def interrupt(self) -> None:
        """Discard waiting scans after the pose was lost."""
        for check in self._checks.values():
            check.interrupt()

    def late_s(self, sensor: str) -> float:
        """Stamps of this laser behind those of the first; 0 where they agree."""
        check = self._checks.get(sensor)
        return 0.0 if check is None else check.late_s

    def fault_of(self, sensor: str) -> Reason:
        """NO_REASON where the stamps of this laser agree with those of the first."""
        check = self._checks.get(sensor)
        if check is None or check.late_s == 0.0:
            return NO_REASON
        is_late = "late" if check.late_s > 0.0 else "early"
        return Reason(
            "laser_stamps",
            f"has stamps that are {abs(check.late_s) * 1e3:.0f} ms {is_late} against those of {self.first} "
            f"(sigma {check.sigma_s * 1e3:.1f}), by the turns that both saw; it is not mapped beside that. "
            "Correct latency_ms of the one that is wrong (corridor calibrate measures it), or its clock",
        )
