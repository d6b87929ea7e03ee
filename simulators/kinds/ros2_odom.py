"""A fake ROS 2 node with wheels as a type of device: its options and its wire."""

from pydantic import Field

from drivers.frames import OdometrySample
from drivers.irobot_create.config import PRESETS
from service.encoding import ODOMETRY
from service.geometry.se2 import SE2
from simulators.device_kind import DeviceKind
from simulators.kinds.ros2_node import NodeOptions, serve
from simulators.ros2_node import FakeNode, NodeSetup
from simulators.truth import CREATE_WHEELS, Ride, WheelTruth
from simulators.zenoh_wire import ZenohWire

WHEEL_BASE_M = PRESETS["create2"].wheel_base_m
VARIANCE = 1e-3  # m^2, rad^2 on the diagonal, as drivers write it that do not know theirs


class OdomOptions(NodeOptions):
    """Options of `ros2_odom:`."""

    rate_hz: float = Field(default=50.0, gt=0.0, le=200.0)


class _Odometry:
    """Adds up what the wheels rolled."""

    def __init__(self, name: str, wheels: WheelTruth, period_s: float) -> None:
        self._name = name
        self._wheels = wheels
        self._period_s = period_s
        self._rolled_m: tuple[float, float] | None = None
        self._pose = SE2()

    def __call__(self, at_ns: int) -> OdometrySample:
        left_m, right_m = self._wheels.wheel_travel_m(at_ns)
        before_left_m, before_right_m = self._rolled_m or (left_m, right_m)
        self._rolled_m = (left_m, right_m)
        forward_m = ((left_m - before_left_m) + (right_m - before_right_m)) / 2.0
        turn_rad = ((right_m - before_right_m) - (left_m - before_left_m)) / WHEEL_BASE_M
        self._pose = self._pose @ SE2.exp(forward_m, 0.0, turn_rad)
        return OdometrySample(
            sensor=self._name,
            stamp_ns=at_ns,
            arrived_ns=at_ns,
            x_m=self._pose.x_m,
            y_m=self._pose.y_m,
            theta_rad=self._pose.theta_rad,
            twist_mps_radps=(forward_m / self._period_s, 0.0, turn_rad / self._period_s),
            covariance=(VARIANCE, 0.0, 0.0, 0.0, VARIANCE, 0.0, 0.0, 0.0, VARIANCE),
        )


def build(name: str, options: OdomOptions, ride: Ride, seed: int) -> ZenohWire:
    wheels = WheelTruth(ride, name, CREATE_WHEELS, seed)
    setup = NodeSetup(round(1e9 / options.rate_hz), clock_drift_ppm=options.clock_drift_ppm)
    measure = _Odometry(name, wheels, 1.0 / options.rate_hz)
    return serve(FakeNode(measure, setup), options, "/wheels/odom", ODOMETRY)


KIND = DeviceKind(OdomOptions, build)
