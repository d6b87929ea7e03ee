"""Samples for the tests of fusion."""

import numpy as np
import numpy.typing as npt

from drivers.frames import ImuSample, OdometrySample
from service.estimator.motion import Measurement
from service.geometry.se2 import SE2

MS = 1_000_000
SURE = np.diag([1e-6, 1e-6, 1e-8])


def odometry(stamp_ms: float, pose: SE2) -> OdometrySample:
    stamp_ns = round(stamp_ms * MS)
    return OdometrySample(
        "base", stamp_ns, stamp_ns, pose.x_m, pose.y_m, pose.theta_rad, (0.0, 0.0, 0.0), (0.0,) * 9
    )


def gyro(stamp_ms: float, rate_radps: float) -> ImuSample:
    stamp_ns = round(stamp_ms * MS)
    return ImuSample("imu", stamp_ns, stamp_ns, (0.0, 0.0, rate_radps), (0.0, 0.0, 9.81))


def matched(pose: SE2, covariance: npt.NDArray[np.float64] = SURE) -> Measurement:
    """Covariance of a scan alone."""
    return Measurement(pose, covariance, np.linalg.inv(covariance), is_joined=False)
