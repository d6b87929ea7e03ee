import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.stores import ros2_jazzy as ros

from drivers.frames import (
    CAUSES,
    NO_INTENSITY,
    Frame,
    GnssFix,
    ImuSample,
    LaserScan,
    OdometrySample,
    causes_of,
    no_distance,
)
from service import encoding
from service.encoding import decode_frame, encode_frame
from service.encoding.frames import MAX_FORCE_MPS2, MAX_ODOMETRY, MAX_RATE_RADPS
from service.errors import InputError

STORE = get_typestore(Stores.ROS2_JAZZY)
T0_NS = 1_700_000_000_123_456_789


def scan(range_m, intensity=NO_INTENSITY, **changes):
    values = {
        "sensor": "front",
        "stamp_ns": 5_000_000_000,
        "arrived_ns": 5_020_000_000,
        "beam_interval_ns": 27_778,
        "scan_period_ns": 20_000_000,
        "first_angle_rad": -2.0,
        "angle_step_rad": 0.5,
        "range_min_m": 0.05,
        "range_max_m": 25.0,
        "range_m": np.asarray(range_m, dtype=np.float32),
        "intensity": intensity,
    }
    return LaserScan(**(values | changes))


def ros_scan(ranges, **changes):
    """A LaserScan message of another program, as bytes."""
    values = {
        "header": ros.std_msgs__msg__Header(ros.builtin_interfaces__msg__Time(12, 34), "laser"),
        "angle_min": -1.0,
        "angle_max": 1.0,
        "angle_increment": 0.25,
        "time_increment": 0.0,
        "scan_time": 0.0,
        "range_min": 0.1,
        "range_max": 10.0,
        "ranges": np.asarray(ranges, dtype=np.float32),
        "intensities": np.empty(0, dtype=np.float32),
    }
    return serialized(ros.sensor_msgs__msg__LaserScan(**(values | changes)), encoding.LASER_SCAN)


def serialized(message, type_name, **options):
    return bytes(STORE.serialize_cdr(message, type_name, **options))


def bits(frame: Frame) -> tuple[object, ...]:
    """Every field of a frame, arrays and floats as their bytes, so that NaN, -0.0 and the last bit count."""
    fields = (getattr(frame, name) for name in frame.__slots__)
    return (type(frame), *(np.asarray(f).tobytes() if not isinstance(f, str | None) else f for f in fields))


def through_the_wire(frame: Frame) -> Frame | None:
    message = encode_frame(frame)
    return decode_frame(message.type, message.payload, frame.sensor, message.log_ns)


times = st.integers(min_value=0, max_value=2**31 * 1_000_000_000 - 1)
durations = st.integers(min_value=0, max_value=2_000_000_000)
finite = st.floats(allow_nan=False, allow_infinity=False)
metres = st.floats(-1e6, 1e6)
rates = st.tuples(*[st.floats(-MAX_RATE_RADPS, MAX_RATE_RADPS)] * 3)
forces = st.tuples(*[st.floats(-MAX_FORCE_MPS2, MAX_FORCE_MPS2)] * 3)
of_odometry = st.floats(-MAX_ODOMETRY, MAX_ODOMETRY)
names = st.sampled_from(["front", "rear_left", "l"])


@st.composite
def scans(draw):
    count = draw(st.integers(1, 40))
    ranges = hnp.arrays(np.float32, count, elements=st.floats(width=32))
    with_intensity = draw(st.booleans())
    return LaserScan(
        sensor=draw(names),
        stamp_ns=draw(times),
        arrived_ns=draw(times),
        beam_interval_ns=draw(durations),
        scan_period_ns=draw(durations),
        first_angle_rad=draw(st.floats(-7, 7)),
        angle_step_rad=draw(st.floats(1e-4, 0.1)) * draw(st.sampled_from([1, -1])),
        range_min_m=draw(st.floats(0, 1)),
        range_max_m=draw(st.floats(2, 1e3)),
        range_m=draw(ranges),
        intensity=draw(ranges) if with_intensity else NO_INTENSITY,
    )


imu_samples = st.builds(
    ImuSample,
    sensor=names,
    stamp_ns=times,
    arrived_ns=times,
    rate_radps=rates,
    force_mps2=forces,
    orientation_wxyz=st.none() | st.tuples(finite, finite, finite, finite),
)
odometry_samples = st.builds(
    OdometrySample,
    sensor=names,
    stamp_ns=times,
    arrived_ns=times,
    x_m=metres,
    y_m=metres,
    theta_rad=st.floats(-100, 100) | st.sampled_from([math.pi, -math.pi, 0.0, -0.0, math.pi / 2]),
    twist_mps_radps=st.tuples(*[of_odometry] * 3),
    covariance=st.tuples(*[of_odometry] * 9),
)
fixes = st.builds(
    GnssFix,
    sensor=names,
    stamp_ns=times,
    arrived_ns=times,
    status=st.integers(-1, 2),
    latitude_deg=st.floats(-90, 90),
    longitude_deg=st.floats(-180, 180),
    altitude_m=metres,
    covariance=st.just((0.0,) * 9) | st.tuples(*[finite] * 9),
)


@given(scans() | imu_samples | odometry_samples | fixes)
def test_a_frame_that_went_through_the_wire_once_never_changes_again(frame):
    once = through_the_wire(frame)
    assert bits(through_the_wire(once)) == bits(once)


@given(odometry_samples)
def test_odometry_keeps_its_heading_to_a_picoradian(sample):
    decoded = through_the_wire(sample)
    assert abs(math.remainder(decoded.theta_rad - sample.theta_rad, math.tau)) < 1e-12
    assert (decoded.x_m, decoded.y_m, decoded.twist_mps_radps, decoded.covariance) == (
        sample.x_m,
        sample.y_m,
        sample.twist_mps_radps,
        sample.covariance,
    )


def test_a_scan_keeps_all_that_a_mapper_needs():
    original = scan([1.5, np.nan, 24.0], intensity=np.array([10, 20, 30], dtype=np.float32))
    message = encode_frame(original, utc_offset_ns=T0_NS)
    assert (message.channel, message.type) == ("front/scan", "sensor_msgs/msg/LaserScan")
    assert message.stamp_ns == original.stamp_ns + T0_NS
    assert message.log_ns == original.arrived_ns + T0_NS
    decoded = decode_frame(message.type, message.payload, "front", message.log_ns)
    assert decoded.stamp_ns == message.stamp_ns
    assert decoded.arrived_ns == message.log_ns
    assert decoded.beam_interval_ns == 27_778
    assert decoded.scan_period_ns == 20_000_000
    assert (decoded.first_angle_rad, decoded.angle_step_rad) == (-2.0, 0.5)
    assert decoded.range_min_m == pytest.approx(0.05)
    assert decoded.range_max_m == 25.0
    np.testing.assert_array_equal(decoded.range_m, np.array([1.5, np.nan, 24.0], dtype=np.float32))
    np.testing.assert_array_equal(decoded.intensity, original.intensity)
    for array in (decoded.range_m, decoded.intensity):
        assert array.dtype == np.float32
        assert array.flags.aligned
        assert not array.flags.writeable


def test_a_scan_is_an_ordinary_ros_message():
    message = encode_frame(scan([1.5, np.nan, 2.0]), utc_offset_ns=T0_NS)
    content = STORE.deserialize_cdr(message.payload, message.type)
    assert message.payload[:4] == b"\x00\x01\x00\x00"
    assert content.header.frame_id == "front"
    assert content.header.stamp.sec * 10**9 + content.header.stamp.nanosec == message.stamp_ns
    assert content.angle_max == pytest.approx(-1.0)
    assert content.time_increment == pytest.approx(27.778e-6)
    assert content.scan_time == pytest.approx(0.02)
    assert content.ranges[1] == np.inf
    assert content.intensities.size == 0


def test_why_a_beam_has_no_distance_goes_over_the_wire_as_a_nan_that_others_read():
    range_m = np.concatenate(
        (np.array([1.5, np.nan], np.float32), no_distance("dazzled", "no_return", "rain"))
    )
    message = encode_frame(scan(range_m))
    ranges = STORE.deserialize_cdr(message.payload, message.type).ranges
    assert np.isnan(ranges).tolist() == [False, False, True, False, True]
    assert np.isposinf(ranges).tolist() == [False, True, False, True, False]
    decoded = decode_frame(message.type, message.payload, "front", 9)
    assert [CAUSES[cause] for cause in causes_of(decoded.range_m)[2:]] == ["dazzled", "no_return", "rain"]
    assert np.isnan(decoded.range_m).tolist() == [False, True, True, True, True]
    foreign = np.array([0x7FC00000, 0xFFC00000, 0x7FFFFFFF, 0x7F800001], np.uint32).view(np.float32)
    assert causes_of(foreign).tolist() == [0, 0, 0, 0]


def test_foreign_ranges_outside_the_limits_are_no_return():
    """range_min itself, as float32, is a distance; range_max itself is "nothing seen" for many drivers."""
    ranges = [5.0, 0.1, 0.05, 0.0, -1.0, 10.0, 10.5, np.inf, -np.inf, np.nan]
    decoded = decode_frame(encoding.LASER_SCAN, ros_scan(ranges), "laser", 9)
    assert np.isfinite(decoded.range_m).tolist() == [True, True, *[False] * 8]


def test_a_foreign_zero_is_no_return_even_where_range_min_is_zero():
    decoded = decode_frame(encoding.LASER_SCAN, ros_scan([0.0, 1.0], range_min=0.0), "laser", 9)
    assert np.isnan(decoded.range_m[0])


@pytest.mark.parametrize(
    ("range_min", "range_max"), [(10.0, 10.0), (1e4, 10.0), (np.inf, 10.0), (200.0, 0.0)]
)
def test_a_scan_whose_range_limits_contradict_each_other_is_no_use(range_min, range_max):
    scan = ros_scan([5.0, 50.0], range_min=range_min, range_max=range_max)
    assert decode_frame(encoding.LASER_SCAN, scan, "laser", 9) is None


@pytest.mark.parametrize("range_max", [0.0, np.inf, np.nan])
def test_a_foreign_scan_without_range_max_keeps_its_ranges(range_max):
    decoded = decode_frame(encoding.LASER_SCAN, ros_scan([50.0, np.inf], range_max=range_max), "laser", 9)
    assert decoded.range_m[0] == 50.0
    assert np.isnan(decoded.range_m[1])
    assert decoded.range_max_m == 100.0


def test_a_foreign_scan_without_times_is_one_instant():
    decoded = decode_frame(
        encoding.LASER_SCAN, ros_scan([1.0], time_increment=np.nan, scan_time=-1.0), "laser", 9
    )
    assert (decoded.beam_interval_ns, decoded.scan_period_ns) == (0, 0)
    assert decoded.stamp_ns == 12_000_000_034


def test_a_foreign_scan_may_sweep_clockwise_and_bring_senseless_intensities():
    payload = ros_scan([1.0, 2.0], angle_increment=-0.25, intensities=np.ones(1, np.float32))
    decoded = decode_frame(encoding.LASER_SCAN, payload, "laser", 9)
    assert decoded.angle_step_rad == -0.25
    assert decoded.intensity.size == 0


def test_a_scan_whose_last_beam_was_measured_first_is_turned_into_the_order_of_time():
    """As drivers of lasers mounted upside down send it: ranges turned round, time_increment below 0."""
    payload = ros_scan([1.0, 2.0, 3.0], time_increment=-1e-3, intensities=np.arange(3, dtype=np.float32))
    decoded = decode_frame(encoding.LASER_SCAN, payload, "laser", 9)
    assert decoded.range_m.tolist() == [3.0, 2.0, 1.0]
    assert decoded.intensity.tolist() == [2.0, 1.0, 0.0]
    assert decoded.range_m.flags.c_contiguous
    assert decoded.intensity.flags.c_contiguous
    assert (decoded.first_angle_rad, decoded.angle_step_rad) == (-0.5, -0.25)
    assert decoded.beam_interval_ns == 1_000_000
    assert decoded.stamp_ns == 12_000_000_034 - 2_000_000  # of ranges[2]


def test_big_endian_scans_read_the_same():
    message = STORE.deserialize_cdr(ros_scan([1.5, 2.5]), encoding.LASER_SCAN)
    payload = serialized(message, encoding.LASER_SCAN, little_endian=False)
    decoded = decode_frame(encoding.LASER_SCAN, payload, "laser", 9)
    assert decoded.range_m.tolist() == [1.5, 2.5]
    assert decoded.range_m.dtype.isnative


@pytest.mark.parametrize("little_endian", [True, False])
@pytest.mark.parametrize("frame", ["laser", "/laser", "", "größer"])
def test_the_frame_of_a_message_is_read_from_its_header_alone(frame, little_endian):
    message = STORE.deserialize_cdr(ros_scan([1.5]), encoding.LASER_SCAN)
    message.header.frame_id = frame
    payload = serialized(message, encoding.LASER_SCAN, little_endian=little_endian)
    assert encoding.frame_id(payload) == frame.lstrip("/")
    header_bytes = 4 + 8 + 4 + len(frame.encode()) + 1
    assert encoding.frame_id(payload[:header_bytes]) == frame.lstrip("/")
    for length in range(header_bytes):
        with pytest.raises(InputError, match="cannot begin with a std_msgs/Header"):
            encoding.frame_id(payload[:length])


@pytest.mark.parametrize(
    "payload",
    [
        ros_scan([]),
        ros_scan([1.0, 2.0], angle_increment=0.0),
        ros_scan([1.0, 2.0], angle_increment=np.nan),
        ros_scan([1.0, 2.0], angle_increment=20.0),
        ros_scan([1.0, 2.0], angle_min=np.inf),
    ],
    ids=["no beams", "no step", "step NaN", "more than a turn", "no first angle"],
)
def test_a_scan_that_says_nothing_is_none(payload):
    assert decode_frame(encoding.LASER_SCAN, payload, "laser", 9) is None


def test_an_imu_without_orientation_says_so_on_the_wire():
    sample = ImuSample("imu", 1, 2, (0.1, 0.2, 0.3), (0.0, 0.0, 9.81))
    message = encode_frame(sample)
    content = STORE.deserialize_cdr(message.payload, message.type)
    assert content.orientation_covariance[0] == -1.0
    assert through_the_wire(sample) == sample


def test_an_imu_without_gyroscope_is_none():
    message = encode_frame(ImuSample("imu", 1, 2, (0.1, 0.2, 0.3), (0.0, 0.0, 9.81)))
    content = STORE.deserialize_cdr(message.payload, message.type)
    content.angular_velocity_covariance = np.array([-1.0, *[0.0] * 8])
    assert decode_frame(encoding.IMU, serialized(content, encoding.IMU), "imu", 9) is None


@given(fixes.filter(lambda fix: fix.status >= 0))
def test_a_fix_comes_back_bit_for_bit(fix):
    message = encode_frame(fix)
    assert (message.channel, message.type) == (f"{fix.sensor}/fix", "sensor_msgs/msg/NavSatFix")
    decoded = through_the_wire(fix)
    if any(fix.covariance):
        assert bits(decoded) == bits(fix)
    else:
        assert decoded == fix


def test_a_fix_is_an_ordinary_ros_message():
    diagonal = (4.0, 0.0, 0.0, 0.0, 4.0, 0.0, 0.0, 0.0, 9.0)
    for covariance, kind in (((0.0,) * 9, 0), (diagonal, 2), ((4.0, 1.0, *diagonal[2:]), 3)):
        message = encode_frame(GnssFix("imu", 5, 6, 1, 60.161, 24.546, 51.7, covariance), utc_offset_ns=T0_NS)
        content = STORE.deserialize_cdr(message.payload, message.type)
        assert content.header.frame_id == "imu"
        assert content.header.stamp.sec * 10**9 + content.header.stamp.nanosec == T0_NS + 5
        assert (content.latitude, content.longitude, content.altitude) == (60.161, 24.546, 51.7)
        assert (content.status.status, content.position_covariance_type) == (1, kind)
        assert tuple(content.position_covariance) == covariance


def test_a_receiver_without_a_fix_has_no_place():
    lost = GnssFix("imu", 1, 2, -1, 0.0, 0.0, 0.0, (1.0,) * 9)
    decoded = through_the_wire(lost)
    assert decoded.status == -1
    assert math.isnan(decoded.latitude_deg)
    assert not any(decoded.covariance)
    assert through_the_wire(GnssFix("imu", 1, 2, 0, math.nan, 0.0, 0.0, (0.0,) * 9)) is None


def test_a_fix_without_an_altitude_is_content():
    """sensor_msgs/NavSatFix: "quiet NaN if no altitude is available"."""
    flat = GnssFix("imu", 1, 2, 0, 60.161, 24.546, math.nan, (4.0, 0, 0, 0, 4.0, 0, 0, 0, 9.0))
    decoded = through_the_wire(flat)
    assert math.isnan(decoded.altitude_m)
    assert (decoded.latitude_deg, decoded.covariance) == (60.161, flat.covariance)
    endless = GnssFix("imu", 1, 2, 0, 60.161, 24.546, math.inf, flat.covariance)
    assert through_the_wire(endless) is None


def test_odometry_of_a_tilted_foreign_base_gives_its_yaw():
    """Roll 20 deg about x after a yaw of 40 deg about z: q = q_yaw * q_roll."""
    yaw, roll = math.radians(40.0), math.radians(20.0)
    message = encode_frame(OdometrySample("base", 1, 2, 1.0, 2.0, 0.0, (0.0, 0.0, 0.0), (0.0,) * 9))
    content = STORE.deserialize_cdr(message.payload, message.type)
    q = content.pose.pose.orientation
    q.w, q.x = math.cos(yaw / 2) * math.cos(roll / 2), math.cos(yaw / 2) * math.sin(roll / 2)
    q.y, q.z = math.sin(yaw / 2) * math.sin(roll / 2), math.sin(yaw / 2) * math.cos(roll / 2)
    decoded = decode_frame(encoding.ODOMETRY, serialized(content, encoding.ODOMETRY), "base", 9)
    assert decoded.theta_rad == pytest.approx(yaw)


def test_other_types_are_none_and_broken_bytes_are_refused():
    assert decode_frame("sensor_msgs/msg/Image", b"\x00\x01\x00\x00", "camera", 9) is None
    with pytest.raises(InputError, match="3 bytes cannot be read as a sensor_msgs/msg/LaserScan"):
        decode_frame(encoding.LASER_SCAN, b"\x00\x01\x00", "front", 9)
    with pytest.raises(InputError, match="cannot be read as a sensor_msgs/msg/LaserScan"):
        decode_frame(encoding.LASER_SCAN, encode_frame(scan([1.0, 2.0])).payload[:-6], "front", 9)


def test_what_a_sensor_upside_down_says_is_turned_back():
    """Turned about its forward axis: what it calls left is right, and down is up."""
    level = scan([1.0, 2.0, 3.0])
    message = encode_frame(level)
    turned = decode_frame(message.type, message.payload, "front", 9, upside_down=True)
    assert (turned.first_angle_rad, turned.angle_step_rad) == pytest.approx(
        (-level.first_angle_rad, -level.angle_step_rad)
    )
    message = encode_frame(ImuSample("imu", 1, 2, (0.1, 0.2, 0.3), (1.0, 2.0, -9.8), (1.0, 0.0, 0.0, 0.0)))
    turned = decode_frame(message.type, message.payload, "imu", 9, upside_down=True)
    assert (turned.rate_radps, turned.force_mps2) == ((0.1, -0.2, -0.3), (1.0, -2.0, 9.8))
    assert turned.orientation_wxyz is None


@pytest.mark.parametrize(
    "damaged",
    [
        ImuSample("imu", 1, 2, (0.0, 0.0, 1e300), (0.0, 0.0, 9.81)),
        ImuSample("imu", 1, 2, (0.0, 0.0, 0.1), (-1e30, 0.0, 9.81)),
        OdometrySample("base", 1, 2, -1e300, 0.0, 0.0, (0.0, 0.0, 0.0), (0.0,) * 9),
        OdometrySample("base", 1, 2, math.nan, 0.0, 0.0, (0.0, 0.0, 0.0), (0.0,) * 9),
    ],
    ids=["rate", "force", "position", "no number"],
)
def test_values_that_no_sensor_measures_are_damage(damaged):
    message = encode_frame(damaged)
    assert decode_frame(message.type, message.payload, damaged.sensor, 2) is None


def odometry_bytes(
    covariance: float, w: float = 1.0, *, at: tuple[int, ...] = (0, 7, 35), little_endian: bool = True
) -> bytes:
    """nav_msgs/Odometry at (1, 2), with that value in these cells of the covariance of the pose."""
    message = encode_frame(OdometrySample("base", 1, 2, 1.0, 2.0, 0.0, (0.5, 0.0, 0.0), (0.0,) * 9))
    content = STORE.deserialize_cdr(message.payload, message.type)
    content.pose.covariance = np.array([covariance if cell in at else 0.0 for cell in range(36)])
    content.pose.pose.orientation.w = w
    return serialized(content, encoding.ODOMETRY, little_endian=little_endian)


@pytest.mark.parametrize("little_endian", [True, False])
@pytest.mark.parametrize("covariance", [math.nan, math.inf, 1e13, -1e200])
def test_a_covariance_that_is_none_takes_no_pose_with_it(covariance, little_endian):
    payload = odometry_bytes(covariance, little_endian=little_endian)
    decoded = decode_frame(encoding.ODOMETRY, payload, "base", 2)
    assert decoded == OdometrySample("base", 1, 2, 1.0, 2.0, 0.0, (0.5, 0.0, 0.0), (0.0,) * 9)
    assert encoding.odometry_fault(payload) == encoding.NO_COVARIANCE


def test_an_orientation_of_0_is_no_rotation():
    payload = odometry_bytes(math.nan, w=0.0)
    assert decode_frame(encoding.ODOMETRY, payload, "base", 2) is None
    assert encoding.odometry_fault(payload) == encoding.NO_ROTATION


def test_odometry_without_a_fault_has_none():
    assert encoding.odometry_fault(odometry_bytes(1e6)) == ""
    assert encoding.odometry_fault(odometry_bytes(math.nan, at=(14, 21, 28))) == ""  # z, roll, pitch
    assert encoding.odometry_fault(b"\x00\x01\x00") == ""
