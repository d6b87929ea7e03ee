"""What is believed about the vehicle's motion, and who believes it."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from drivers.frames import ImuSample, OdometrySample
from service.geometry.se2 import SE2


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """Pose, twist and how sure of the pose; the same words before matching and after it."""

    pose_odom_base: SE2
    twist_base: tuple[float, float, float]  # m/s forward, m/s left, rad/s
    covariance: npt.NDArray[np.float64]  # (3, 3) of x, y, theta of the pose, in base axes; m^2, m rad, rad^2


@dataclass(frozen=True, slots=True, eq=False)
class Prediction(Motion):
    """A motion before matching, and what the match may learn from it."""

    step_covariance: npt.NDArray[np.float64]  # (3, 3) of the way since the last match alone, in base axes
    elapsed_s: float  # since the last match; 0: there was none
    twist_gain: float  # share of a correction of the pose that is put down to the twist
    is_measured: bool  # wheels measured the way; else it is the last speed gone on


@dataclass(frozen=True, slots=True, eq=False)
class Matched(Motion):
    """A motion after matching, and what the motion model may learn from it."""

    information: npt.NDArray[np.float64]  # (3, 3) what the scan alone says of the pose, in base axes
    on_new_map: bool = False  # one begun where no scan fitted: what was lost until then stays lost
    pull_base: tuple[float, float, float] = (0.0, 0.0, 0.0)  # m, m, rad that the prediction held it back by


class MotionModel(Protocol):
    """Predicts where the vehicle is when a scan begins, from whatever moves with it."""

    @property
    def complaint(self) -> str:
        """Which sensor is left out since walls contradict it, what was measured, where to look; or ""."""
        ...

    def add(self, sample: ImuSample | OdometrySample) -> bool:
        """Take in a sample; False if it came out of order and was left out."""
        ...

    def predict(self, stamp_ns: int) -> Prediction: ...

    def correct(self, stamp_ns: int, matched: Motion) -> Motion:
        """Take in where a match puts the vehicle; gives what is believed then: the match, or a mean with it.

        A prediction handed back as it was is no match, for nothing was measured.
        """
        ...
