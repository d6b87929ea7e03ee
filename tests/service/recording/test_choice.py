"""Which topics and frames of a recording of others are used: found, or named by options and config."""

import math
from dataclasses import replace

import pytest

from drivers.frames import LaserScan, OdometrySample
from service import encoding
from service.encoding import Message
from service.errors import InputError, UsageError
from service.recording.choice import Choice
from service.recording.mcap_source import open_session
from tests.service.recording.foreign import LEVEL, STORE, tf_payload, turn
from tests.service.recording.sessions import (
    PERIOD_NS,
    T0_NS,
    drive,
    odometry_message,
    pose_at,
    scan_message,
    write_file,
)

SCANS = 5


def odometry(index, frame, child):
    content = STORE.deserialize_cdr(odometry_message(index).payload, encoding.ODOMETRY)
    content.header.frame_id, content.child_frame_id = frame, child
    log_ns = T0_NS + index * PERIOD_NS
    return Message(
        "", encoding.ODOMETRY, log_ns, log_ns, bytes(STORE.serialize_cdr(content, encoding.ODOMETRY))
    )


def moving(index, *edges):
    """/tf of the drive's pose at that scan, for each (frame, child)."""
    at, stamp_ns = pose_at(index), T0_NS + index * PERIOD_NS
    place = (at.x_m, at.y_m, 0.0), turn(yaw=math.degrees(at.theta_rad))
    payload = tf_payload(stamp_ns, *((frame, child, *place) for frame, child in edges))
    return Message("", encoding.TF, stamp_ns, stamp_ns, payload)


def robot(foreign, prefix, topics, in_tf=False):
    """A laser 0.2 m ahead of a base with odometry, all frames behind a prefix."""
    base = f"{prefix}base_link"
    foreign.tf((base, f"{prefix}laser", (0.2, 0.0, 0.1), turn(yaw=10.0)))
    for k in range(SCANS):
        if in_tf:
            foreign.add_message("/tf", moving(k, ("map", f"{prefix}odom"), (f"{prefix}odom", base)))
        else:
            foreign.add_message(f"{topics}odom", odometry(k, f"{prefix}odom", base))
        foreign.add_message(f"{topics}scan", scan_message(k, f"{prefix}laser"))
    return foreign


def two_robots(foreign, in_tf=False):
    robot(foreign, "robot1/", "/robot1/", in_tf)
    return robot(foreign, "robot2/", "/robot2/", in_tf).close()


@pytest.mark.parametrize("in_tf", [False, True], ids=["Odometry", "tf"])
def test_lasers_of_two_robots_are_refused_with_their_bases_and_the_option(foreign, in_tf):
    with pytest.raises(
        InputError,
        match=r"on 2 bases: /robot1/scan on robot1/base_link, /robot2/scan on robot2/base_link; name one by "
        r"--base-frame \(robot1/base_link or robot2/base_link\)",
    ):
        open_session(two_robots(foreign, in_tf))


@pytest.mark.parametrize("in_tf", [False, True], ids=["Odometry", "tf"])
@pytest.mark.parametrize(
    "choice", [{"base_frame": "/robot2/base_link"}, {"scan_topics": ("robot2/scan",)}], ids=str
)
def test_one_robot_of_two_is_mapped_with_its_own_odometry(foreign, choice, in_tf):
    session = open_session(two_robots(foreign, in_tf), Choice(**choice))
    odom = "/tf/odom" if in_tf else "/robot2/odom"
    assert set(session.devices) == {"/robot2/scan", odom}
    assert session.mountings["robot2"].x_m == pytest.approx(0.2)
    assert not session.unmounted
    kinds = [type(frame) for frame in session.frames()]
    assert (kinds.count(LaserScan), kinds.count(OdometrySample)) == (SCANS, SCANS)
    if in_tf:
        assert "odometry is robot2/odom to robot2/base_link (5) of /tf" in session.notes


def test_robots_with_the_same_frames_are_distinguished_by_their_namespaces(foreign):
    foreign.tf(("base_link", "laser", (0.2, 0.0, 0.1), LEVEL))
    for k in range(2 * SCANS):  # robot2 says more
        for name in ("robot1", "robot2") if k < SCANS else ("robot2",):
            foreign.add_message(f"/{name}/odom", odometry(k, "odom", "base_link"))
        foreign.add_message("/robot1/scan", scan_message(k, "laser"))
        if k == 0:
            foreign.add_message("/robot2/scan", scan_message(k, "laser"))
    session = open_session(foreign.close())
    assert set(session.devices) == {"/robot1/scan", "/robot1/odom"}


def test_odometry_of_tf_that_no_one_knows_is_named_in_a_warning_and_by_options(foreign):
    foreign.tf(("chassis", "laser", (0.2, 0.0, 0.1), LEVEL))
    for k in range(SCANS):
        foreign.add_message("/tf", moving(k, ("world", "dead_reckoning"), ("dead_reckoning", "chassis")))
        foreign.add_message("/scan", scan_message(k, "laser"))
        foreign.add_message("/tf", moving(0, ("world", "beacon")))
    paths = foreign.close()
    session = open_session(paths)
    assert not any(isinstance(frame, OdometrySample) for frame in session.frames())
    assert session.unmounted
    (warning,) = session.warnings
    assert "dead_reckoning to chassis (5), world to dead_reckoning (5)" in warning
    assert "beacon" not in warning  # which does not move
    assert "--odom-frame and --base-frame" in warning
    session = open_session(paths, Choice(odom_frame="dead_reckoning", base_frame="chassis"))
    assert session.mountings["scan"].x_m == 0.2
    assert sum(isinstance(frame, OdometrySample) for frame in session.frames()) == SCANS


def test_a_named_topic_is_used_although_another_is_more_usual(foreign):
    robot(foreign, "", "/")
    for k in range(SCANS):
        foreign.add_message("/wheels", odometry(k, "wheels", "base_link"))
        foreign.add_message("/filtered_scan", scan_message(k, "laser"))
    paths = foreign.close()
    assert set(open_session(paths).devices) == {"/scan", "/odom"}
    by_topic = Choice(scan_topics=("/filtered_scan",), odom_topic="/wheels")
    assert set(open_session(paths, by_topic).devices) == {"/filtered_scan", "/wheels"}
    assert set(open_session(paths, Choice(odom_frame="wheels")).devices) == {"/scan", "/wheels"}


def test_odometry_in_tf_is_used_beside_an_odometry_where_tf_is_named(foreign):
    robot(foreign, "", "/")
    foreign.add_message("/tf", moving(0, ("odom", "base_link")))
    session = open_session(foreign.close(), Choice(odom_topic="/tf"))
    assert set(session.devices) == {"/scan", "/tf/odom"}


@pytest.mark.parametrize(
    ("choice", "words"),
    [
        (
            {"scan_topics": ("/front",)},
            r"--scan-topic /front: no such topic; .* has /scan \(sensor_msgs.*, 5\)",
        ),
        (
            {"scan_topics": ("/odom",)},
            r"--scan-topic /odom: is /odom \(nav_msgs/msg/Odometry, 5\); .* has /scan",
        ),
        ({"odom_topic": "/wheels"}, r"--odom-topic /wheels: no such topic; .* has /odom .*, /tf_static"),
        ({"imu_topic": "/imu"}, r"--imu-topic /imu: no such topic; .* has no sensor_msgs/msg/Imu"),
        ({"base_frame": "base"}, r"--base-frame base: no chosen laser .*; frames in it are base_link, laser"),
        (
            {"odom_frame": "o"},
            r"--odom-frame o: no odometry .*; header.frame_id of its Odometry: odom; edges",
        ),
    ],
)
def test_a_name_that_is_not_there_is_refused_with_those_that_are(foreign, choice, words):
    with pytest.raises(UsageError, match=words):
        open_session(robot(foreign, "", "/").close(), Choice(**choice))


def test_of_a_session_of_ours_topics_are_named_likewise(tmp_path):
    path = tmp_path / "s.mcap"
    write_file(path, [*drive(3), *(replace(scan_message(k), channel="rear/scan") for k in range(3))])
    assert set(open_session([path]).devices) == {"/front/scan", "/rear/scan", "/base/odom"}
    named = open_session([path], Choice(scan_topics=("/rear/scan",)))
    assert set(named.devices) == {"/rear/scan", "/base/odom"}
    with pytest.raises(UsageError, match=r"--base-frame chassis: .* frames in it are base_link, front"):
        open_session([path], Choice(base_frame="chassis"))


@pytest.mark.parametrize(
    "lasers",
    [
        [("/a/b/scan", "one"), ("/a_b/scan", "two"), ("/a_b_scan", "three")],
        [("/scan", "one"), ("/scan", "two"), ("/scan_two", "three")],
    ],
)
def test_each_laser_has_a_name_of_its_own(foreign, lasers):
    for index, (topic, frame) in enumerate(lasers):
        foreign.tf(("base_link", frame, (0.1 * index, 0.0, 0.0), LEVEL))
        foreign.add_message(topic, scan_message(index, frame))
    session = open_session(foreign.close())
    frames = list(session.frames())
    assert [session.mountings[frame.sensor].x_m for frame in frames] == pytest.approx([0.0, 0.1, 0.2])


def test_odometry_of_tf_is_read_from_topics_without_a_slash_too(foreign):
    foreign.tf(("base_link", "laser", (0.2, 0.0, 0.0), LEVEL))
    for index in range(SCANS):
        foreign.add_message("tf", moving(index, ("odom", "base_link")))
        foreign.add_message("scan", scan_message(index, "laser"))
    session = open_session(foreign.close())
    assert [type(frame) for frame in session.frames()] == [OdometrySample, LaserScan] * SCANS
