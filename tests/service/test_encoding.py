import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.stores import ros2_jazzy as ros

from drivers.frames import NO_INTENSITY, Frame, GnssFix, ImuSample, LaserScan, OdometrySample
from service import encoding
from service.encoding import LogClock, Status, decode_frame, encode_frame
from service.errors import InputError
from service.geometry.se2 import SE2
from service.mapper.steering import Control
from service.outputs import Grid, MapperOutput, TileUpdate

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


def through_the_wire(frame: Frame, utc_offset_ns: int = 0) -> Frame | None:
    message = encode_frame(frame, utc_offset_ns)
    return decode_frame(message.type, message.payload, frame.sensor, message.log_ns)


times = st.integers(min_value=0, max_value=2**31 * 1_000_000_000 - 1)
durations = st.integers(min_value=0, max_value=2_000_000_000)
finite = st.floats(allow_nan=False, allow_infinity=False)
metres = st.floats(-1e6, 1e6)
triples = st.tuples(finite, finite, finite)
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
    rate_radps=triples,
    force_mps2=triples,
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
    twist_mps_radps=triples,
    covariance=st.tuples(*[finite] * 9),
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
    assert once is not None
    again = through_the_wire(once)
    assert again is not None
    assert bits(again) == bits(once)


@given(odometry_samples)
def test_odometry_keeps_its_heading_to_a_picoradian(sample):
    decoded = through_the_wire(sample)
    assert isinstance(decoded, OdometrySample)
    assert abs(math.remainder(decoded.theta_rad - sample.theta_rad, math.tau)) < 1e-12
    assert (decoded.x_m, decoded.y_m, decoded.twist_mps_radps, decoded.covariance) == (
        sample.x_m,
        sample.y_m,
        sample.twist_mps_radps,
        sample.covariance,
    )


def test_no_heading_creeps_when_it_is_encoded_again_and_again():
    headings_rad = np.random.default_rng(1).uniform(-math.pi, math.pi, 3000).tolist()
    for heading_rad in [*headings_rad, math.pi, -math.pi]:
        sample = OdometrySample("base", 1, 2, 0.0, 0.0, heading_rad, (0.0, 0.0, 0.0), (0.0,) * 9)
        once = through_the_wire(sample)
        assert once is not None
        assert through_the_wire(once) == once


def test_a_scan_keeps_all_that_a_mapper_needs():
    original = scan([1.5, np.nan, 24.0], intensity=np.array([10, 20, 30], dtype=np.float32))
    message = encode_frame(original, utc_offset_ns=T0_NS)
    assert (message.channel, message.type) == ("front/scan", "sensor_msgs/msg/LaserScan")
    assert message.stamp_ns == original.stamp_ns + T0_NS
    assert message.log_ns == original.arrived_ns + T0_NS
    decoded = decode_frame(message.type, message.payload, "front", message.log_ns)
    assert isinstance(decoded, LaserScan)
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


def test_a_log_time_given_is_the_arrival_time_of_the_decoded_frame():
    message = encode_frame(scan([1.0]), log_ns=77)
    decoded = decode_frame(message.type, message.payload, "front", message.log_ns)
    assert decoded is not None
    assert decoded.arrived_ns == message.log_ns == 77


@pytest.mark.parametrize(
    ("value", "kept"),
    [
        (5.0, True),
        (0.1, True),  # range_min itself, as float32
        (0.05, False),
        (0.0, False),
        (-1.0, False),
        (10.0, False),  # range_max itself: "nothing seen" for many drivers
        (10.5, False),
        (np.inf, False),
        (-np.inf, False),
        (np.nan, False),
    ],
)
def test_foreign_ranges_outside_the_limits_are_no_return(value, kept):
    decoded = decode_frame(encoding.LASER_SCAN, ros_scan([value, 1.0]), "laser", 9)
    assert isinstance(decoded, LaserScan)
    assert bool(np.isfinite(decoded.range_m[0])) is kept
    assert decoded.range_m[1] == 1.0


def test_a_foreign_zero_is_no_return_even_where_range_min_is_zero():
    decoded = decode_frame(encoding.LASER_SCAN, ros_scan([0.0, 1.0], range_min=0.0), "laser", 9)
    assert isinstance(decoded, LaserScan)
    assert np.isnan(decoded.range_m[0])


@pytest.mark.parametrize("range_max", [0.0, np.inf, np.nan])
def test_a_foreign_scan_without_range_max_keeps_its_ranges(range_max):
    decoded = decode_frame(encoding.LASER_SCAN, ros_scan([50.0, np.inf], range_max=range_max), "laser", 9)
    assert isinstance(decoded, LaserScan)
    assert decoded.range_m[0] == 50.0
    assert np.isnan(decoded.range_m[1])
    assert decoded.range_max_m == 100.0


def test_a_foreign_scan_without_times_is_one_instant():
    decoded = decode_frame(
        encoding.LASER_SCAN, ros_scan([1.0], time_increment=np.nan, scan_time=-1.0), "laser", 9
    )
    assert isinstance(decoded, LaserScan)
    assert (decoded.beam_interval_ns, decoded.scan_period_ns) == (0, 0)
    assert decoded.stamp_ns == 12_000_000_034


def test_a_foreign_scan_may_sweep_clockwise_and_bring_senseless_intensities():
    payload = ros_scan([1.0, 2.0], angle_increment=-0.25, intensities=np.ones(1, np.float32))
    decoded = decode_frame(encoding.LASER_SCAN, payload, "laser", 9)
    assert isinstance(decoded, LaserScan)
    assert decoded.angle_step_rad == -0.25
    assert decoded.intensity.size == 0


def test_big_endian_scans_read_the_same():
    message = STORE.deserialize_cdr(ros_scan([1.5, 2.5]), encoding.LASER_SCAN)
    payload = serialized(message, encoding.LASER_SCAN, little_endian=False)
    decoded = decode_frame(encoding.LASER_SCAN, payload, "laser", 9)
    assert isinstance(decoded, LaserScan)
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
        with pytest.raises(InputError, match="do not begin with a std_msgs/Header"):
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
    assert decoded is not None
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


def test_a_receiver_without_a_fix_is_told_of_without_a_place():
    lost = GnssFix("imu", 1, 2, -1, 0.0, 0.0, 0.0, (1.0,) * 9)
    decoded = through_the_wire(lost)
    assert isinstance(decoded, GnssFix)
    assert decoded.status == -1
    assert math.isnan(decoded.latitude_deg)
    assert not any(decoded.covariance)
    assert through_the_wire(GnssFix("imu", 1, 2, 0, math.nan, 0.0, 0.0, (0.0,) * 9)) is None


def test_odometry_that_is_not_finite_is_none():
    sample = OdometrySample("base", 1, 2, math.nan, 0.0, 0.0, (0.0, 0.0, 0.0), (0.0,) * 9)
    assert through_the_wire(sample) is None


def test_odometry_of_a_tilted_foreign_base_gives_its_yaw():
    """Roll 20 deg about x after a yaw of 40 deg about z: q = q_yaw * q_roll."""
    yaw, roll = math.radians(40.0), math.radians(20.0)
    message = encode_frame(OdometrySample("base", 1, 2, 1.0, 2.0, 0.0, (0.0, 0.0, 0.0), (0.0,) * 9))
    content = STORE.deserialize_cdr(message.payload, message.type)
    q = content.pose.pose.orientation
    q.w, q.x = math.cos(yaw / 2) * math.cos(roll / 2), math.cos(yaw / 2) * math.sin(roll / 2)
    q.y, q.z = math.sin(yaw / 2) * math.sin(roll / 2), math.sin(yaw / 2) * math.cos(roll / 2)
    decoded = decode_frame(encoding.ODOMETRY, serialized(content, encoding.ODOMETRY), "base", 9)
    assert isinstance(decoded, OdometrySample)
    assert decoded.theta_rad == pytest.approx(yaw)


def test_other_types_are_none_and_broken_bytes_are_refused():
    assert decode_frame("sensor_msgs/msg/Image", b"\x00\x01\x00\x00", "camera", 9) is None
    with pytest.raises(InputError, match="3 bytes are not a sensor_msgs/msg/LaserScan"):
        decode_frame(encoding.LASER_SCAN, b"\x00\x01\x00", "front", 9)
    with pytest.raises(InputError, match="are not a sensor_msgs/msg/LaserScan"):
        decode_frame(encoding.LASER_SCAN, encode_frame(scan([1.0, 2.0])).payload[:-6], "front", 9)


OUTPUT = MapperOutput(
    stamp_ns=T0_NS,
    pose_odom_base=SE2(1.0, 2.0, math.pi / 2),
    pose_map_odom=SE2(0.5, 0.0, 0.0),
    twist_base=(0.7, 0.0, 0.1),
    covariance=np.diag([0.04, 0.01, 0.001]),  # 0.2 m along the vehicle, 0.1 m across
    state="ok",
    reason="",
    match_share=0.9,
)


def test_pose_covariance_is_in_the_axes_of_the_map():
    message = encoding.encode_pose(OUTPUT, T0_NS + 5)
    content = STORE.deserialize_cdr(message.payload, message.type)
    assert (message.channel, message.stamp_ns, message.log_ns) == ("pose", T0_NS, T0_NS + 5)
    assert (content.header.frame_id, content.child_frame_id) == ("map", "base_link")
    assert (content.pose.pose.position.x, content.pose.pose.position.y) == (1.5, 2.0)
    covariance = content.pose.covariance.reshape(6, 6)
    assert covariance[0, 0] == pytest.approx(0.01)  # the vehicle looks along the map's y
    assert covariance[1, 1] == pytest.approx(0.04)
    assert covariance[5, 5] == pytest.approx(0.001)
    assert np.diag(covariance)[2:5].tolist() == [1e6] * 3  # z, roll and pitch, which nobody observes
    np.testing.assert_allclose(covariance, np.diag(np.diag(covariance)), atol=1e-12)
    assert content.twist.twist.linear.x == 0.7
    assert content.twist.twist.angular.z == 0.1
    np.testing.assert_array_equal(content.twist.covariance.reshape(6, 6), 1e6 * np.eye(6))
    decoded = encoding.decode_pose(message.payload)
    assert decoded.pose == SE2(1.5, 2.0, pytest.approx(math.pi / 2, abs=1e-12))
    np.testing.assert_allclose(decoded.covariance, OUTPUT.covariance, atol=1e-12)
    assert (decoded.stamp_ns, decoded.frame, decoded.child) == (T0_NS, "map", "base_link")
    assert decoded.twist == OUTPUT.twist_base


@pytest.mark.parametrize("encode", [encoding.encode_pose, encoding.encode_odom])
def test_a_direction_that_is_not_known_says_so_and_the_other_stays(encode):
    """A corridor that has been followed on the last speed alone, at 30 degrees in the map."""
    along, across = 2383.0**2, 0.01**2
    pose = SE2(0.0, 0.0, math.radians(30.0))
    covariance = np.diag([along, across, 1e-4])
    covariance[0, 2] = covariance[2, 0] = 10.0
    output = replace(OUTPUT, pose_odom_base=pose, pose_map_odom=SE2(), covariance=covariance)
    message = encode(output, T0_NS)
    content = STORE.deserialize_cdr(message.payload, message.type)
    planar = content.pose.covariance.reshape(6, 6)[np.ix_([0, 1, 5], [0, 1, 5])]
    variances, axes = np.linalg.eigh(planar[:2, :2])
    np.testing.assert_allclose(variances, [across, 1e6], rtol=1e-5)
    np.testing.assert_allclose(np.abs(axes[:, 1]), [math.cos(pose.theta_rad), math.sin(pose.theta_rad)])
    np.testing.assert_array_equal(planar[2], [0.0, 0.0, 1e-4])


def test_a_heading_that_may_be_any_and_what_is_no_number_are_not_known():
    lost = np.array([[4.0, 0.0, 1.0], [0.0, 9.0, 1.0], [1.0, 1.0, 500.0]])
    decoded = encoding.decode_pose(encoding.encode_pose(replace(OUTPUT, covariance=lost), 1).payload)
    np.testing.assert_allclose(decoded.covariance, np.diag([4.0, 9.0, 1e6]), atol=1e-9)
    nan = np.full((3, 3), np.nan)
    decoded = encoding.decode_pose(encoding.encode_pose(replace(OUTPUT, covariance=nan), 1).payload)
    np.testing.assert_allclose(decoded.covariance, 1e6 * np.eye(3), atol=1e-6)


def test_wheels_do_not_claim_to_know_what_the_plane_leaves_open():
    sample = OdometrySample(
        "base", 1, 1, 1.0, 2.0, 0.5, (0.5, 0.0, 0.0), tuple(np.diag([0.1, 0.2, 0.3]).ravel())
    )
    content = STORE.deserialize_cdr(encode_frame(sample).payload, encoding.ODOMETRY)
    np.testing.assert_array_equal(
        content.pose.covariance.reshape(6, 6), np.diag([0.1, 0.2, 1e6, 1e6, 1e6, 0.3])
    )


def test_odom_and_tf_agree_with_pose():
    odom = encoding.decode_pose(encoding.encode_odom(OUTPUT, T0_NS).payload)
    assert (odom.frame, odom.pose.x_m, odom.pose.y_m) == ("odom", 1.0, 2.0)
    tf = encoding.decode_transforms(encoding.encode_tf(OUTPUT, T0_NS).payload)
    assert [(t.frame, t.child) for t in tf] == [("map", "odom"), ("odom", "base_link")]
    assert [t.translation_m for t in tf] == [(0.5, 0.0, 0.0), (1.0, 2.0, 0.0)]
    assert {t.stamp_ns for t in tf} == {T0_NS}


def test_mountings_go_out_as_static_transforms():
    mountings = {"front": SE2(0.2, 0.0, 0.0), "rear": SE2(-0.3, 0.1, math.pi)}
    message = encoding.encode_tf_static(mountings, T0_NS, T0_NS)
    transforms = encoding.decode_transforms(message.payload)
    assert message.channel == "tf_static"
    assert [(t.frame, t.child) for t in transforms] == [("base_link", "front"), ("base_link", "rear")]
    assert transforms[1].translation_m == (-0.3, 0.1, 0.0)
    assert transforms[1].rotation_wxyz == pytest.approx((0.0, 0.0, 0.0, 1.0))
    once = encoding.decode_mountings(message.payload)
    assert once["rear"].theta_rad == pytest.approx(math.pi)
    again = encoding.encode_tf_static(once, T0_NS, T0_NS)
    assert encoding.decode_mountings(again.payload) == once


def test_a_grid_survives_and_its_rows_run_along_x():
    cells = np.array([[-1, 0, 100], [50, -1, 7]], dtype=np.int8)
    grid = Grid(version=3, cell_m=0.05, x_min_m=-1.5, y_min_m=2.0, cells=cells)
    message = encoding.encode_grid(grid, T0_NS, T0_NS + 1)
    content = STORE.deserialize_cdr(message.payload, message.type)
    assert (content.info.width, content.info.height) == (3, 2)
    assert content.data.tolist() == [-1, 0, 100, 50, -1, 7]
    decoded = encoding.decode_grid(message.payload)
    assert (decoded.cell_m, decoded.x_min_m, decoded.y_min_m) == (0.05, -1.5, 2.0)
    np.testing.assert_array_equal(decoded.cells, cells)


def test_a_tile_lies_where_its_indices_say():
    tile = TileUpdate(level=1, ix=-2, iy=3, version=9, cell_m=0.5, cells=np.zeros((4, 4), dtype=np.int8))
    message = encoding.encode_tile(tile, T0_NS, T0_NS)
    assert message.channel == "map/tile/1/-2/3"
    decoded = encoding.decode_grid(message.payload)
    assert (decoded.x_min_m, decoded.y_min_m) == (-4.0, 6.0)


def test_a_grid_of_another_size_than_it_says_is_refused():
    content = STORE.deserialize_cdr(
        encoding.encode_grid(Grid(0, 0.05, 0.0, 0.0, np.zeros((2, 2), np.int8)), 1, 1).payload,
        encoding.OCCUPANCY_GRID,
    )
    content.info.width = 3
    with pytest.raises(InputError, match="3 x 2 cells has 4 values"):
        encoding.decode_grid(serialized(content, encoding.OCCUPANCY_GRID))


def test_diagnostics_and_events_survive():
    statuses = [Status("front", 0, "streaming", {"rate_hz": "50.0"}), Status("base", 2, "down", {})]
    message = encoding.encode_diagnostics("diagnostics", statuses, T0_NS, T0_NS)
    assert message.channel == "diagnostics"
    assert encoding.decode_diagnostics(message.payload) == statuses
    event = encoding.encode_event('{"event": "mark"}', T0_NS, T0_NS)
    assert (event.channel, encoding.decode_event(event.payload)) == ("events", '{"event": "mark"}')


@pytest.mark.parametrize("what", ["pause", "resume", "reset_map"])
def test_a_wish_to_the_mapper_is_read_from_its_event(what):
    event = encoding.encode_event(f'{{"event": "{what}", "id": "7"}}', T0_NS, T0_NS)
    assert encoding.decode_control(event.payload, T0_NS + 3) == Control(what, T0_NS + 3)


@pytest.mark.parametrize(
    "text", ['{"event": "mark", "text": "pause"}', '["pause"]', '{"event": ["pause"]}', "1"]
)
def test_other_events_are_no_wishes(text):
    assert encoding.decode_control(encoding.encode_event(text, 1, 1).payload, 1) is None


@pytest.mark.parametrize("text", ["pause", "", "[" * 100_000])
def test_an_event_that_is_no_json_is_bad_input(text):
    with pytest.raises(InputError, match="an event that is no JSON"):
        encoding.decode_control(encoding.encode_event(text, 1, 1).payload, 1)


def test_type_hashes_are_those_of_ros_2_jazzy():
    """std_msgs/String as printed in the design document of rmw_zenoh."""
    assert encoding.type_hash(encoding.STRING) == (
        "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
    )
    assert "float32[] ranges" in encoding.schema_text(encoding.LASER_SCAN)
    assert "MSG: std_msgs/Header" in encoding.schema_text(encoding.LASER_SCAN)


def test_warm_up_reads_and_writes_every_type():
    encoding.warm_up()


def test_log_times_rise_strictly_and_follow_the_clock():
    clock = LogClock()
    assert [clock.next_ns(t) for t in (10, 10, 5, 20)] == [10, 12, 14, 20]
