import numpy as np

from service.api.poses import pose_in_message, pose_of
from service.encoding import encode_pose
from service.geometry.se2 import SE2
from service.outputs import MapperOutput, Reason

COVARIANCE = np.diag([0.04, 0.01, 0.001])
OUTPUT = MapperOutput(
    *(7, SE2(1.0, 2.0, 0.0), SE2(0.0, 0.0, np.pi / 2), (0.5, 0.0, 0.1), COVARIANCE),
    *("degraded", Reason("drift", "sigma 0.2 m"), 0.9),
)


def test_a_pose_is_in_the_map_and_so_is_its_covariance():
    pose = pose_of(OUTPUT)
    np.testing.assert_allclose((pose.x_m, pose.y_m, pose.theta_rad), (-2.0, 1.0, np.pi / 2), atol=1e-9)
    np.testing.assert_allclose(pose.covariance, np.diag([0.01, 0.04, 0.001]), atol=1e-12)  # forward is y
    np.testing.assert_array_equal(pose.twist, (0.5, 0.0, 0.1))
    assert (pose.stamp_ns, pose.state, pose.reason) == (7, "degraded", "sigma 0.2 m")


def test_a_subscriber_has_the_same_to_the_last_digit():
    here, there = pose_of(OUTPUT), pose_in_message(encode_pose(OUTPUT, 9).payload)
    assert (here.x_m, here.y_m, here.theta_rad) == (there.x_m, there.y_m, there.theta_rad)
    np.testing.assert_array_equal(here.covariance, there.covariance)
    assert (there.state, there.reason) == (None, "")
