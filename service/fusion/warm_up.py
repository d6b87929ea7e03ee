"""The kernels of the error-state filter once, on a made-up second of driving, so that they are compiled."""

import numpy as np

from drivers.frames import ImuSample, OdometrySample
from service.fusion.estimator import Estimator, EstimatorConfig
from service.fusion.motion import Measurement

STEP_NS = 100_000_000


def warm_up_estimator() -> None:
    """Two predictions and a correction: another third of all compiling, of which no other kernel knows."""
    estimator = Estimator(EstimatorConfig())
    for k in range(12):
        stamp_ns = k * STEP_NS
        estimator.add(ImuSample("imu", stamp_ns, stamp_ns, (0.0, 0.0, 0.0), (0.0, 0.0, 9.81)))
        estimator.add(
            OdometrySample("base", stamp_ns, stamp_ns, 0.1 * k, 0.0, 0.0, (1.0, 0.0, 0.0), (0.0,) * 9)
        )
    estimator.predict(0)
    predicted = estimator.predict(11 * STEP_NS)
    estimator.correct(Measurement(predicted.pose_odom_base, 1e-4 * np.eye(3), 1e4 * np.eye(3)))
    estimator.settle(1.0)
