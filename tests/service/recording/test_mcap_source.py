import math
from dataclasses import replace

import numpy as np
import pytest
from rosbags.typesys.stores import ros2_jazzy as ros

from drivers.frames import NO_INTENSITY, GnssFix, ImuSample, LaserScan, OdometrySample
from service import encoding
from service.encoding import Message, decode_frame, encode_frame
from service.errors import InputError
from service.geometry.se2 import SE2
from service.mapper.mapping_session import SessionRequest
from service.recording.mcap_source import open_session
from tests.service.recording.foreign import LEVEL, STORE, turn
from tests.service.recording.sessions import MOUNTINGS, T0_NS, drive, scan_message, write_file


def bits(frame):
    fields = (getattr(frame, name) for name in frame.__slots__)
    return tuple(f.tobytes() if isinstance(f, np.ndarray) else f for f in fields)


def test_our_session_gives_back_the_very_frames_the_mapper_had(tmp_path):
    messages = drive(50)
    live = [
        decode_frame(m.type, m.payload, m.channel.split("/")[0], m.log_ns)
        for m in messages
        if m.channel != "tf_static"
    ]
    write_file(tmp_path / "b.mcap", messages[60:])
    write_file(tmp_path / "a.mcap", messages[:60])
    session = open_session([tmp_path / "b.mcap", tmp_path / "a.mcap"])
    assert session.sensors == {"/base/odom": "base", "/front/scan": "front"}
    assert session.mountings == {"front": SE2(0.2, 0.0, pytest.approx(MOUNTINGS["front"].theta_rad))}
    assert session.metadata == {"config": {"vehicle": "test"}}
    for _ in range(2):  # it can be read again
        replayed = list(session.frames())
        assert [bits(frame) for frame in replayed] == [bits(frame) for frame in live]
        assert session.counters == {"/base/odom": 50, "/front/scan": 50}


def test_mountings_of_our_session_are_those_of_the_live_mapper_to_the_last_bit(tmp_path):
    for yaw_rad in np.random.default_rng(2).uniform(-math.pi, math.pi, 20).tolist():
        mountings = encoding.encode_tf_static({"front": SE2(0.123, -0.456, yaw_rad)}, T0_NS, T0_NS)
        path = tmp_path / f"{yaw_rad}.mcap"
        write_file(path, [mountings, scan_message(0)])
        assert open_session([path]).mountings == encoding.decode_mountings(mountings.payload)


def test_requests_come_at_their_place_among_the_frames(tmp_path):
    scans = [scan_message(k) for k in range(4)]
    between_ns = scans[1].log_ns + 1
    events = [
        encoding.encode_event('{"event": "start"}', T0_NS, T0_NS),
        encoding.encode_event('{"event": "pause"}', between_ns, between_ns),
        encoding.encode_event("what?", between_ns, between_ns),
        encoding.encode_event('{"event": "resume", "id": "a"}', scans[3].log_ns + 1, scans[3].log_ns + 1),
    ]
    write_file(tmp_path / "s.mcap", [encoding.encode_tf_static(MOUNTINGS, T0_NS, T0_NS), *scans, *events])
    session = open_session([tmp_path / "s.mcap"])
    steps = list(session.steps())
    half = [LaserScan, LaserScan, SessionRequest]
    assert [type(step) for step in steps] == half * 2
    assert [step for step in steps if isinstance(step, SessionRequest)] == [
        SessionRequest("pause", between_ns),
        SessionRequest("resume", scans[3].log_ns + 1),
    ]
    assert session.counters == {"/front/scan": 4, "/events unusable": 1}
    assert len(list(session.frames())) == 4


def odometry(frame="odom", child="base_link", variance=0.0, is_turned=True):
    sample = OdometrySample("x", T0_NS, T0_NS, 1.0, 2.0, 0.5, (0.0, 0.0, 0.0), (0.0,) * 9)
    content = STORE.deserialize_cdr(encode_frame(sample).payload, encoding.ODOMETRY)
    content.header.frame_id, content.child_frame_id = frame, child
    content.pose.covariance = np.full(36, variance)
    if not is_turned:
        content.pose.pose.orientation.z = content.pose.pose.orientation.w = 0.0
    payload = bytes(STORE.serialize_cdr(content, encoding.ODOMETRY))
    return Message("", encoding.ODOMETRY, T0_NS, T0_NS, payload)


def test_a_foreign_laser_is_found_by_type_and_mounted_by_its_chain(foreign):
    paths = (
        foreign.tf(
            ("base_footprint", "base_link", (0.0, 0.0, 0.1), LEVEL),
            ("base_link", "mast", (0.3, 0.1, 0.5), turn(yaw=90.0)),
            ("mast", "front", (0.2, 0.0, 0.0), turn(yaw=-30.0)),
        )
        .add_message("/scan", scan_message(0))
        .add_message("/odom", odometry())
        .close()
    )
    session = open_session(paths)
    assert session.sensors == {"/scan": "scan", "/odom": "odom"}
    pose = session.mountings["scan"]
    assert (pose.x_m, pose.y_m) == pytest.approx((0.3, 0.3))
    assert math.degrees(pose.theta_rad) == pytest.approx(60.0)
    assert session.metadata == {}
    assert {type(frame) for frame in session.frames()} == {LaserScan, OdometrySample}


def fix_message(index: int, sensor: str) -> Message:
    fix = GnssFix(sensor, T0_NS + index, T0_NS + index, 0, 60.1, 24.5, 51.0, (4.0, 0, 0, 0, 4.0, 0, 0, 0, 9))
    return encode_frame(fix)


def test_fixes_of_our_session_come_with_the_antenna(tmp_path):
    mounted = encoding.encode_tf_static({**MOUNTINGS, "imu/antenna": SE2(-0.5, 0.1, 0.0)}, T0_NS, T0_NS)
    write_file(tmp_path / "s.mcap", [mounted, scan_message(0), fix_message(1, "imu")])
    session = open_session([tmp_path / "s.mcap"])
    assert session.sensors["/imu/fix"] == "imu"
    assert session.antennas == {"imu/antenna": SE2(-0.5, 0.1, 0.0)}
    assert GnssFix in {type(frame) for frame in session.frames()}


def test_of_foreign_receivers_one_is_read_and_its_antenna_may_be_tilted(foreign):
    foreign.tf(
        ("base_link", "roof", (0.2, 0.0, 1.5), turn(yaw=90.0)),
        ("roof", "gps", (0.3, 0.1, 0.0), turn(pitch=35.0)),
    )
    foreign.add_message("/scan", scan_message(0))
    for topic, sensor in (("/gps/fix", "gps"), ("/gps/fix", "gps"), ("/other/fix", "other")):
        foreign.add_message(topic, fix_message(1, sensor))
    session = open_session(foreign.close())
    assert session.sensors["/gps/fix"] == "gps"
    antenna = session.antennas["gps"]
    assert (antenna.x_m, antenna.y_m) == pytest.approx((0.2 - 0.1, 0.3))
    assert any(note.startswith("passed over /other/fix") for note in session.notes)
    assert sum(isinstance(frame, GnssFix) for frame in session.frames()) == 2


def test_a_receiver_without_a_chain_is_taken_as_unmounted_and_reported(foreign):
    foreign.add_message("/scan", scan_message(0)).add_message("/fix", fix_message(1, "gps"))
    session = open_session(foreign.close())
    assert session.antennas == {}
    assert any("does not lead from gps to base_link or base_footprint" in note for note in session.notes)


def test_what_the_odometry_moves_is_the_base(foreign):
    foreign.tf(
        ("base_footprint", "base_link", (1.0, 0.0, 0.1), LEVEL),
        ("base_link", "front", (0.2, 0.0, 0.5), LEVEL),
    )
    foreign.add_message("/scan", scan_message(0)).add_message("/odom", odometry(child="base_footprint"))
    assert open_session(foreign.close()).mountings["scan"] == SE2(1.2, 0.0, 0.0)


def test_odometry_of_others_is_read_whatever_they_publish_as_a_pose(foreign):
    """p2os_driver calls its odometry /pose, which in our sessions is the base in the map."""
    foreign.add_message("/front/scan", scan_message(0)).add_message("/pose", odometry())
    assert open_session(foreign.close()).sensors == {"/front/scan": "front", "/pose": "pose"}


def test_our_topics_are_known_where_another_program_recorded_them(foreign):
    foreign.add_message("/front/scan", scan_message(0)).add_message("/odom", odometry())
    foreign.add_message("/pose", odometry("map"))
    assert open_session(foreign.close()).sensors == {"/front/scan": "front"}


def test_a_laser_upside_down_is_mirrored(foreign):
    foreign.tf(("base_link", "front", (0.1, 0.0, 0.2), turn(roll=180.0)))
    session = open_session(foreign.add_message("/scan", scan_message(0)).close())
    (frame,) = session.frames()
    original = decode_frame(encoding.LASER_SCAN, scan_message(0).payload, "scan", 0)
    assert (frame.first_angle_rad, frame.angle_step_rad) == (
        -original.first_angle_rad,
        -original.angle_step_rad,
    )
    np.testing.assert_array_equal(frame.range_m, original.range_m)
    assert session.mountings["scan"].theta_rad == pytest.approx(0.0)
    assert any("upside down" in note for note in session.notes)


@pytest.mark.parametrize(
    ("later", "is_reported"),
    [
        (("base_link", "front", (0.2, 0.0, 0.5), LEVEL), False),
        (("base_link", "front", (0.2, 0.1, 0.5), LEVEL), True),
        (("mast", "front", (0.2, 0.0, 0.5), LEVEL), True),
        (("base_link", "camera", (0.3, 0.0, 0.5), LEVEL), False),  # no chosen sensor sits on it
    ],
)
def test_two_mountings_of_one_laser_are_a_warning(foreign, later, is_reported: bool):
    foreign.tf(("base_link", "front", (0.2, 0.0, 0.5), LEVEL), ("base_link", "camera", (0.0,) * 3, LEVEL))
    foreign.tf(later)
    session = open_session(foreign.add_message("/scan", scan_message(0)).close())
    assert session.mountings["scan"] == SE2(0.2, 0.0, 0.0)
    if not is_reported:
        assert session.warnings == []
        return
    (warning,) = session.warnings
    parent, x_m = later[0], later[2][0]
    assert "base_link to front: x 0.2, y 0, z 0.5 m, yaw 0 deg, which is used" in warning
    assert f"later {parent} to front: x {x_m:.3g}" in warning


@pytest.mark.parametrize(
    ("place", "why"),
    [
        (((0.1, 0.0, 0.2), turn(pitch=35.0)), "tilted by 35 deg against base_link; at most 10 can be mapped"),
        (((0.0, -1e300, 0.0), LEVEL), r"1e\+300 m away from base_link; at most 50 m along an axis"),
    ],
)
def test_a_laser_that_looks_at_the_floor_or_is_far_from_the_vehicle_is_refused(foreign, place, why: str):
    foreign.tf(("base_link", "front", *place))
    with pytest.raises(InputError, match=why):
        open_session(foreign.add_message("/scan", scan_message(0)).close())


def two_lasers_in_one_topic(foreign):
    """Two scans of the laser at front, then one of that at rear ..."""
    for index in range(9):
        foreign.add_message("/scan", scan_message(index, sensor="rear" if index % 3 == 2 else "front"))


def test_two_lasers_in_one_topic_are_distinguished_each_with_its_mounting(foreign):
    foreign.tf(
        ("base_link", "front", (0.2, 0.0, 0.0), LEVEL),
        ("base_link", "rear", (-0.3, 0.0, 0.0), turn(yaw=180.0)),
    )
    two_lasers_in_one_topic(foreign)
    session = open_session(foreign.close())
    assert session.devices == {"/scan": {"front": "scan", "rear": "scan_rear"}}
    assert session.scan_counts == {"scan": 6, "scan_rear": 3}
    assert session.mountings["scan"] == SE2(0.2, 0.0, 0.0)
    assert session.mountings["scan_rear"].x_m == -0.3
    assert [frame.sensor for frame in session.frames()] == ["scan", "scan", "scan_rear"] * 3
    assert session.shared_topics == {
        "/scan": {"front": {"messages": 6, "sensor": "scan"}, "rear": {"messages": 3, "sensor": "scan_rear"}}
    }


@pytest.mark.parametrize("mounted", ["front", "rear", None])
def test_of_two_lasers_in_one_topic_that_without_a_mounting_is_refused(foreign, mounted):
    """Where neither has one, that which sends less: of one alone the origin would be taken."""
    if mounted:
        foreign.tf(("base_link", mounted, (0.2, 0.0, 0.0), LEVEL))
    two_lasers_in_one_topic(foreign)
    session = open_session(foreign.close())
    read, refused = ("rear", "front") if mounted == "rear" else ("front", "rear")
    frames = list(session.frames())
    assert len(frames) == (3 if mounted == "rear" else 6)
    sensor = "scan_rear" if mounted == "rear" else "scan"
    assert {frame.sensor for frame in frames} == {sensor}
    assert session.counters == {"/scan": len(frames), "/scan refused": 9 - len(frames)}
    facts = session.shared_topics["/scan"]
    assert (facts[read]["sensor"], facts[refused]["sensor"]) == (sensor, None)
    assert any(
        note.startswith(f"passed over frame_id '{refused}' in /scan") and "not the only one" in note
        for note in session.notes
    )


def test_what_cannot_be_used_is_reported_by_topic_and_why(foreign):
    foreign.add_message("/scan", scan_message(0))
    for message in (
        odometry(), odometry(variance=math.nan), odometry(variance=1e13), odometry(is_turned=False),
        replace(odometry(), payload=odometry().payload[:-8]),
    ):  # fmt: skip
        foreign.add_message("/odom", message)
    session = open_session(foreign.close())
    assert session.losses == []
    assert [type(frame) for frame in session.frames()].count(OdometrySample) == 3
    assert session.losses == [
        "/odom: 2 of 5 messages cannot be used; the orientation of 1 is a quaternion of 0",
        "/odom: the covariance of 2 of 5 messages is none (not finite, or beyond all sense) and counts as "
        "unknown; their poses are used",
    ]


def test_messages_logged_at_a_time_that_no_int64_holds_are_reported(foreign):
    late = replace(scan_message(1), log_ns=2**63)
    session = open_session(foreign.add_message("/scan", scan_message(0)).add_message("/scan", late).close())
    assert len(list(session.frames())) == 1
    assert session.losses == [
        "/scan: 1 of 2 messages cannot be used; of the first the log time is 9223372036854775808 ns"
    ]


@pytest.mark.parametrize(
    ("span_deg", "beam_interval_ns", "is_reported"),
    [(359.0, 0, True), (359.0, 300_000, False), (180.0, 0, False)],
)
def test_a_sweep_all_around_that_claims_to_be_of_one_moment_is_reported(
    foreign, span_deg: float, beam_interval_ns: int, is_reported: bool
):
    beams = 360
    scan = LaserScan(
        "front", 1_000_000_000, 1_000_000_000, beam_interval_ns, 100_000_000, -math.pi,
        math.radians(span_deg) / (beams - 1), 0.1, 12.0, np.full(beams, 2.0, np.float32), NO_INTENSITY,
    )  # fmt: skip
    foreign.add_message("/scan", encode_frame(scan))
    session = open_session(foreign.close())
    assert len(list(session.frames())) == 1
    if not is_reported:
        assert session.losses == []
        return
    (loss,) = session.losses
    assert loss.startswith("/scan: 1 scan (of 1) of more than 200 deg with a time_increment of 0")


def ros_scan(beams: int, step_deg: float, last_deg: float, range_max_m: float = 10.0) -> bytes:
    """A LaserScan of another program, from -90 deg on."""
    header = ros.std_msgs__msg__Header(ros.builtin_interfaces__msg__Time(T0_NS // 10**9, 0), "front")
    first_rad, last_rad, step_rad = map(math.radians, (-90.0, last_deg, step_deg))
    ranges, none = np.full(beams, 2.0, np.float32), np.zeros(0, np.float32)
    scan = ros.sensor_msgs__msg__LaserScan(
        header, first_rad, last_rad, step_rad, 0.0, 0.1, 0.1, range_max_m, ranges, none
    )
    return bytes(STORE.serialize_cdr(scan, encoding.LASER_SCAN))


@pytest.mark.parametrize(
    ("beams", "last_deg", "reported"),
    [
        (181, 90.0, ""),
        (180, 90.0, ""),  # angle_max may lie one step beyond
        (181, 0.0, ""),  # not set
        (91, 90.0, "91 beams at steps of 1 deg from -90 deg end at 0 deg, angle_max is 90 deg"),
        (181, -45.0, "181 beams at steps of 1 deg from -90 deg end at 90 deg, angle_max is -45 deg"),
    ],
)
def test_beams_that_end_elsewhere_than_at_angle_max_are_reported(foreign, beams, last_deg, reported):
    for _ in range(2):
        foreign.add("/scan", encoding.LASER_SCAN, ros_scan(beams, 1.0, last_deg))
    session = open_session(foreign.close())
    assert len(list(session.frames())) == 2
    assert bool(session.losses) is bool(reported)
    if reported:
        (loss,) = session.losses
        assert "/scan: angle_max of 2 scans (of 2) is not where the beams end" in loss
        assert reported in loss


@pytest.mark.parametrize(
    ("scan", "why"),
    [
        (ros_scan(181, 1.0 * 180 / math.pi, 90.0), "181 beams with angle_increment 1 rad span 1.031e+04 deg"),
        (ros_scan(0, 1.0, 90.0), "it has no ranges"),
        (ros_scan(181, 1.0, 90.0, range_max_m=0.05), "range_min 0.1 m is not below range_max 0.05 m"),
    ],
)
def test_why_a_scan_cannot_be_used_is_reported(foreign, scan: bytes, why: str):
    foreign.add("/scan", encoding.LASER_SCAN, scan).add_message("/scan", scan_message(0))
    session = open_session(foreign.close())
    assert len(list(session.frames())) == 1
    (loss,) = session.losses
    assert loss.startswith(f"/scan: 1 of 2 messages cannot be used; of the first {why}")


def test_a_second_odometry_or_imu_in_a_topic_is_refused(foreign):
    foreign.add_message("/scan", scan_message(0))
    for sensor in ("imu", "imu", "camera_imu"):
        imu = encode_frame(ImuSample(sensor, T0_NS, T0_NS, (0.0, 0.0, 0.1), (0.0, 0.0, 9.81)))
        foreign.add_message("/imu", imu)
    for frame in ("visual_odom", "odom", "odom"):
        foreign.add_message("/odom", odometry(frame))
    session = open_session(foreign.close())
    assert len(list(session.frames())) == 5
    assert session.shared_topics == {
        "/imu": {"imu": {"messages": 2, "sensor": "imu"}, "camera_imu": {"messages": 1, "sensor": None}},
        "/odom": {"visual_odom": {"messages": 1, "sensor": None}, "odom": {"messages": 2, "sensor": "odom"}},
    }


def test_of_several_odometries_the_usual_one_is_taken_and_none_in_the_map(foreign):
    foreign.add_message("/scan", scan_message(0))
    for topic, frame in (("/odometry/filtered", "odom"), ("/odom", "odom"), ("/amcl_odom", "map")):
        foreign.add_message(topic, odometry(frame))
    session = open_session(foreign.close())
    assert set(session.sensors) == {"/scan", "/odom"}
    assert any("/amcl_odom" in note and "a result, not odometry" in note for note in session.notes)
    assert any("/odometry/filtered" in note for note in session.notes)


def test_an_imu_that_is_not_level_is_passed_over(foreign):
    imu = encode_frame(ImuSample("imu_link", T0_NS, T0_NS, (0.0, 0.0, 0.1), (0.0, 0.0, 9.81)))
    foreign.tf(
        ("base_link", "front", (0.0, 0.0, 0.0), LEVEL),
        ("base_link", "imu_link", (0.0, 0.0, 0.0), turn(roll=90.0)),
    )
    foreign.add_message("/scan", scan_message(0)).add_message("/imu/data", imu)
    session = open_session(foreign.close())
    assert set(session.sensors) == {"/scan"}
    assert any("/imu/data" in note and "tilted by 90 deg" in note for note in session.notes)


def test_messages_that_are_no_use_are_counted_not_fatal(foreign):
    empty = scan_message(1, beams=1)
    foreign.add_message("/scan", scan_message(0))
    foreign.add("/scan", empty.type, empty.payload[:-4], T0_NS + 1)
    session = open_session(foreign.close())
    assert len(list(session.frames())) == 1
    assert session.counters == {"/scan": 1, "/scan unusable": 1}


@pytest.mark.parametrize("other", [odometry(), Message("", encoding.STRING, T0_NS, T0_NS, b"\0\1\0\0")])
def test_a_topic_of_two_types_is_refused_with_the_file(foreign, other: Message):
    foreign.add_message("/scan", scan_message(0)).add_message("/scan", other)
    with pytest.raises(InputError, match=rf"foreign\.mcap: /scan holds .* two types, .*{other.type}"):
        open_session(foreign.close())


def test_topics_are_counted_before_each_is_looked_into(foreign):
    for index in range(201):
        foreign.add_message(f"/laser_{index}", scan_message(index, beams=3))
    with pytest.raises(InputError, match=r"topics of sensors: 201 topics, at most 200 are read"):
        open_session(foreign.close())


def test_scans_in_another_encoding_are_refused(foreign):
    message = scan_message(0)
    foreign.add("/scan", message.type, message.payload, encoding_name="json")
    with pytest.raises(InputError, match="encoded as 'json'; only ROS 2's cdr is read"):
        open_session(foreign.close())
