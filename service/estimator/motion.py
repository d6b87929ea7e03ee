"""The estimate of the vehicle's motion, and the interface of a motion model."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from drivers.frames import ImuSample, OdometrySample
from service.geometry.se2 import SE2
from service.outputs import Reason

Matrix = npt.NDArray[np.float64]

PAUSE_NS = 1_000_000_000  # without a measurement; after a longer one the motion may be another
WRONG_ODOMETRY_NOISE = 20.0  # times the variance of its model: odometry with larger errors is wrong


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """Pose, its covariance and twist, before or after matching."""

    pose_odom_base: SE2
    twist_base: tuple[float, float, float]  # m/s forward, m/s left, rad/s
    covariance: Matrix  # (3, 3) of x, y, theta against the first scan, base axes; m^2, m rad, rad^2


class OdometryIncrement(NamedTuple):
    """Odometry increment since the last scan, its rotation fused with the gyro's."""

    pose: SE2  # of the base in that of the last scan
    variance_m2: float  # along each axis, but for the extrapolation at both ends
    variance_rad2: float
    end_m2: float = 0.0  # of the extrapolation at its end, which the next increment takes back
    end_rad2: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Prediction(Motion):
    """Motion predicted for a scan, with what the matcher needs."""

    local_covariance: Matrix  # (3, 3) of the pose against the local map, base axes
    twist_covariance: Matrix  # (3, 3) of twist (rows) and pose against the local map, base axes
    elapsed_s: float  # since the last scan; 0: there was none
    travel_m: float  # since the last scan
    is_measured: bool  # odometry or an IMU measured the motion since then; else constant velocity
    is_standing: bool = False  # by odometry that has never moved, which is no measurement
    is_confirmed: bool = False  # both did, and were compared
    odometry_noise: float = 1.0  # learnt factor on the modelled variance of odometry's path length
    pause_s: float = 0.0  # longest time since the last scan without a measurement of the motion
    # Odometry stopped in that pause faster than a vehicle brakes: it may be towed, or wheels slip.
    is_unconfirmed_stop: bool = False
    increment: OdometryIncrement | None = None  # odometry and gyro alone; None: odometry was silent
    samples_dropped: int = 0  # since the last prediction: too many waited for it
    # (3, 3) base axes: of the motion of the detached segment, since it began; None: it stands still
    segment_covariance: Matrix | None = None
    # (beam_time_s, xy_raw, xy_base): deskew a sweep by the measured motion, as deskew_sweep in
    # service/kernels/sweep.py; None: by the twist alone. Valid until the next prediction.
    deskew: Callable[[Matrix, Matrix, Matrix], None] | None = None

    @property
    def is_scan_alone(self) -> bool:
        """Whether only scans measure the motion; see scan_alone."""
        return scan_alone(self.is_measured, self.odometry_noise)

    @property
    def twist_gain(self) -> Matrix:
        """(3, 3) 1/s: correction of the twist per correction of the pose."""
        gain: Matrix = self.twist_covariance @ np.linalg.inv(self.local_covariance)
        return gain

    def after(self, earlier: "Prediction") -> "Prediction":
        """The prediction since the scan before that of an earlier one, whose scan was not matched."""
        parts, elapsed_s = (earlier, self), earlier.elapsed_s + self.elapsed_s
        measured_s = sum(part.elapsed_s for part in parts if part.increment is not None)
        increment = None
        if measured_s > 0.5 * elapsed_s:
            (one, one_m2, one_rad2, _, _), (two, two_m2, two_rad2, *end) = (
                part.increment or part._increment_by_twist() for part in parts
            )
            position_m2 = one_m2 + two_m2 + one_rad2 * (two.x_m**2 + two.y_m**2)
            increment = OdometryIncrement(one @ two, position_m2, one_rad2 + two_rad2, *end)
        return replace(
            self,
            elapsed_s=elapsed_s,
            travel_m=earlier.travel_m + self.travel_m,
            pause_s=max(earlier.pause_s, self.pause_s),
            is_unconfirmed_stop=earlier.is_unconfirmed_stop or self.is_unconfirmed_stop,
            increment=increment,
        )

    def _increment_by_twist(self) -> OdometryIncrement:
        """Where no sample of odometry lies between the scans of two lasers."""
        forward, left, turn = (self.elapsed_s * speed for speed in self.twist_base)
        return OdometryIncrement(SE2.exp(forward, left, turn), 0.0, 0.0)

    def with_added_covariance(self, added: Matrix) -> "Prediction":
        """The prediction with a covariance (3, 3) added to the pose that is uncorrelated with the twist."""
        return replace(self, local_covariance=self.local_covariance + added)

    def twist_at(self, pose_odom_base: SE2) -> tuple[float, float, float]:
        """Twist if the base is at this pose: m/s forward, m/s left, rad/s."""
        off = self.pose_odom_base.between(pose_odom_base).log()
        forward, left, turn = (self.twist_base + self.twist_gain @ off).tolist()
        return forward, left, turn


def scan_alone(is_measured: bool, odometry_noise: float) -> bool:
    """Whether only scans measure the motion: odometry is silent, or wrong by its learnt noise."""
    return not is_measured or odometry_noise > WRONG_ODOMETRY_NOISE


class Measurement(NamedTuple):
    """A matched pose, as input of a motion model.

    pose_odom_base    of prediction and scan together, or of the scan alone
    covariance        (3, 3) of that pose against the local map, base axes
    information       (3, 3) of the scan alone, base axes, without chance [22]; zero: nothing was measured,
                      the pose is the prediction
    prior_weight      weight of the prediction in the match; below 1 it was far off
    gap               (3, 3) covariance to add to the prediction, base axes, where the scan was matched to
                      another segment of the map than the scans before; else None
    segment_noise     (3, 3) covariance, base axes, by which the segment may have moved since the scan before,
                      where nothing else measured the motion; None: it stands still
    is_joined         False: pose and covariance are those of the scan alone; the motion model fuses them with
                      its prediction
    """

    pose_odom_base: SE2
    covariance: Matrix
    information: Matrix
    prior_weight: float = 1.0
    gap: Matrix | None = None
    segment_noise: Matrix | None = None
    is_joined: bool = True


class MotionModel(Protocol):
    """Predicts the pose at the time of a scan from odometry and IMU."""

    @property
    def fault(self) -> Reason:
        """The source that contradicts the others, by how much, and likely causes; or NO_REASON."""
        ...

    def add(self, sample: ImuSample | OdometrySample) -> bool:
        """Take a sample; False if it was dropped: out of order, or not finite."""
        ...

    def begin_at(self, stamp_ns: int) -> None:
        """Set the origin of `odom` to the base at this time, at most a sweep before the first prediction.

        Without this call it is the base at the first prediction.
        """
        ...

    def predict(self, stamp_ns: int) -> Prediction: ...

    def correct(self, measured: Measurement | None) -> Motion:
        """Fuse a match with the newest prediction and return the estimate; None: no match."""
        ...

    def moved(self, seconds: float) -> Motion:
        """The newest estimate, moved by so many seconds forward or back within its sweep."""
        ...

    def settle(self, share: float) -> None:
        """A scan was put into the local map; the error against the map is multiplied by `share`, 0..1."""
        ...
