import math

import numpy as np

from drivers.frames import OdometrySample
from service.offline.score.trajectory import Trajectory
from tests.accuracy.between_scans import with_odometry

S = 10**9


def sample(time_s: float, x_m: float, y_m: float, theta_rad: float) -> OdometrySample:
    stamp_ns = round(time_s * S)
    return OdometrySample("base", stamp_ns, stamp_ns, x_m, y_m, theta_rad, (0.0,) * 3, (0.0,) * 9)


def test_between_two_scans_the_vehicle_goes_where_odometry_says() -> None:
    """It turns left and then drives on; odometry has axes and an origin of its own and is 10 % short."""
    scans = Trajectory(np.array([S, 3 * S]), np.array([[5.0, 5.0, 0.0], [5.0, 6.0, math.pi / 2.0]]))
    turned = -math.pi / 2.0
    samples = [
        sample(0.5, -2.0, 1.0, math.pi),
        sample(1.0, -2.0, 1.0, math.pi),
        sample(2.0, -2.0, 1.0, turned),
        sample(3.0, -2.0, 0.1, turned),
        sample(4.0, -2.0, 0.1, turned),
    ]
    dense = with_odometry(scans, samples)
    np.testing.assert_array_equal(dense.stamp_ns, [S, 2 * S, 3 * S])
    np.testing.assert_array_equal(dense.pose[[0, 2]], scans.pose)
    np.testing.assert_allclose(dense.pose[1], [5.0, 5.05, math.pi / 2.0], atol=1e-12)
