"""The estimate of the vehicle's motion, and the interface of who holds it."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
import numpy.typing as npt

from drivers.frames import ImuSample, OdometrySample
from service.geometry.se2 import SE2
from service.outputs import Reason

Matrix = npt.NDArray[np.float64]

WRONG_ODOMETRY_NOISE = 20.0  # times the variance of its model: odometry with larger errors is wrong


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """Pose, twist and how sure of the pose; the same words before matching and after it."""

    pose_odom_base: SE2
    twist_base: tuple[float, float, float]  # m/s forward, m/s left, rad/s
    covariance: Matrix  # (3, 3) of x, y, theta against the first scan, base axes; m^2, m rad, rad^2


@dataclass(frozen=True, slots=True)
class Reckoned:
    """The step of the base since the last scan by odometry, its rotation joined with the gyro's."""

    pose: SE2  # of the base in that of the last scan
    variance_m2: float  # along each axis
    variance_rad2: float


@dataclass(frozen=True, slots=True, eq=False)
class Prediction(Motion):
    """A motion before matching, and what the match may learn from it."""

    local_covariance: Matrix  # (3, 3) of the pose against the local map, base axes
    twist_gain: Matrix  # (3, 3) 1/s: what a correction of the pose says of the twist
    elapsed_s: float  # since the last scan; 0: there was none
    travel_m: float  # since the last scan
    is_measured: bool  # wheels or an IMU measured the motion since then; else the last speed goes on
    is_confirmed: bool = False  # both did, and were weighed against each other
    odometry_noise: float = 1.0  # variance of odometry's way over that of its model, as learnt
    pause_s: float = 0.0  # the longest since the last scan in which nobody measured the way
    # in that pause wheels stopped faster than a vehicle brakes: it may be towed, or they slip
    is_unwitnessed: bool = False
    reckoned: Reckoned | None = None  # odometry and gyro alone; None: odometry was silent
    samples_dropped: int = 0  # since the last prediction: too many waited for it
    # (begin_s, end_s) from this moment -> what is known there beyond the twist: (K, 3) m, m, rad at K
    # moments evenly between, see service/kernels/sweep.py; None: nothing. Only until the next prediction.
    deviation: Callable[[float, float], Matrix | None] | None = None

    @property
    def is_scan_alone(self) -> bool:
        """Whether nothing but scans measures the way; see scan_alone."""
        return scan_alone(self.is_measured, self.odometry_noise)

    def less_known(self, more: Matrix) -> "Prediction":
        """With so much more covariance of the pose, (3, 3), that has nothing to do with the twist."""
        covariance = self.local_covariance + more
        gain = self.twist_gain @ self.local_covariance @ np.linalg.inv(covariance)
        return replace(self, local_covariance=covariance, twist_gain=gain)

    def twist_at(self, pose_odom_base: SE2) -> tuple[float, float, float]:
        """The twist, were the base at this pose instead: m/s forward, m/s left, rad/s."""
        off = (self.pose_odom_base.inverse() @ pose_odom_base).log()
        forward, left, turn = (self.twist_base + self.twist_gain @ off).tolist()
        return forward, left, turn


def scan_alone(is_measured: bool, odometry_noise: float) -> bool:
    """Whether nothing but scans measures the way: odometry is silent, or wrong by its learnt noise."""
    return not is_measured or odometry_noise > WRONG_ODOMETRY_NOISE


@dataclass(frozen=True, slots=True, eq=False)
class Measurement:
    """What a match says of the pose, to a motion model.

    pose_odom_base    prediction and scan together, or the scan alone; says `covariance`
    covariance        (3, 3) of that pose against the local map, base axes
    information       (3, 3) of the scan alone, base axes, without what it says by chance; zero: nothing was
                      measured, the pose is the prediction
    prior_weight      1, or less where the prediction was so far off that its weight was reduced
    gap               (3, 3) how much less the prediction was known than the model says, base axes: the scan
                      was matched to another piece of the map than those before it; None: not so
    is_joined         False: pose and covariance are those of the scan alone; the motion model joins them with
                      its prediction
    """

    pose_odom_base: SE2
    covariance: Matrix
    information: Matrix
    prior_weight: float = 1.0
    gap: Matrix | None = None
    is_joined: bool = True


class MotionModel(Protocol):
    """Predicts where the vehicle is at a moment of a scan, from whatever moves with it."""

    @property
    def fault(self) -> Reason:
        """Which source contradicts the others, by how much, and where to look; or NO_REASON."""
        ...

    def add(self, sample: ImuSample | OdometrySample) -> bool:
        """Take in a sample; False if it came out of order, or was not a number, and was left out."""
        ...

    def begin_at(self, stamp_ns: int) -> None:
        """`odom` is the base now, at most a sweep before the first prediction; without it, at that one."""
        ...

    def predict(self, stamp_ns: int) -> Prediction: ...

    def correct(self, measured: Measurement | None) -> Motion:
        """Take in what a match says of the newest prediction; None: nothing. Gives the estimate then."""
        ...

    def moved(self, seconds: float) -> Motion:
        """The newest estimate, carried on by so many seconds, or back: within the sweep that it is of."""
        ...

    def settle(self, share: float) -> None:
        """A scan was put into the local map; `share` of the error against it is left, 0..1."""
        ...
