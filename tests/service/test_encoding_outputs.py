"""What the mapper and the service put out, and the events among frames, as ROS messages."""

import math
from dataclasses import replace

import numpy as np
import pytest

from drivers.frames import OdometrySample
from service import encoding
from service.encoding import LogClock, Status, encode_frame
from service.errors import InputError
from service.geometry.se2 import SE2
from service.mapper.mapping_session import ApplyResult, SessionRequest
from service.outputs import NO_REASON, Grid, MapperOutput, TileUpdate
from tests.service.test_encoding import STORE, T0_NS, serialized

OUTPUT = MapperOutput(
    stamp_ns=T0_NS,
    pose_odom_base=SE2(1.0, 2.0, math.pi / 2),
    pose_map_odom=SE2(0.5, 0.0, 0.0),
    twist_base=(0.7, 0.0, 0.1),
    covariance=np.diag([0.04, 0.01, 0.001]),  # 0.2 m along the vehicle, 0.1 m across
    state="ok",
    reason=NO_REASON,
    inlier_ratio=0.9,
)


def test_odom_has_a_covariance_of_its_own_that_no_loop_makes_smaller():
    apart = replace(OUTPUT, odom_covariance=np.diag([4.0, 4.0, 0.01]))

    def known(message):
        return encoding.decode_pose(message.payload).covariance

    np.testing.assert_allclose(known(encoding.encode_pose(apart, T0_NS)), OUTPUT.covariance, atol=1e-12)
    np.testing.assert_allclose(known(encoding.encode_odom(apart, T0_NS)), apart.odom_covariance, atol=1e-12)
    np.testing.assert_allclose(known(encoding.encode_odom(OUTPUT, T0_NS)), OUTPUT.covariance, atol=1e-12)


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
    assert np.diag(covariance)[2:5].tolist() == [1e6] * 3  # z, roll and pitch, which no one observes
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


def test_the_map_lies_below_what_is_shown_on_it_and_that_below_scans_and_path():
    """What lies at one height is rendered in any order by viewers in 3D: the map would hide the scans."""
    cells = np.zeros((2, 2), dtype=np.int8)
    grid, tile = Grid(0, 0.05, 0.0, 0.0, cells), TileUpdate(0, 0, 0, 1, 0.05, cells)
    messages = [encoding.encode_grid(grid, T0_NS, T0_NS), encoding.encode_tile(tile, T0_NS, T0_NS)]
    messages += [encoding.encode_grid(grid, T0_NS, T0_NS, on) for on in (encoding.CHANGES, encoding.STANDING)]
    read = [STORE.deserialize_cdr(message.payload, message.type) for message in messages]
    assert [content.info.origin.position.z for content in read] == [-0.02, -0.02, -0.01, -0.01]


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
def test_a_request_to_the_mapper_is_read_from_its_event(what):
    event = encoding.encode_event(f'{{"event": "{what}", "id": "7"}}', T0_NS, T0_NS)
    assert encoding.decode_step(event.payload, T0_NS + 3) == SessionRequest(what, T0_NS + 3)


def test_a_result_applied_is_read_from_its_event():
    event = encoding.encode_event('{"event": "apply_result"}', T0_NS, T0_NS)
    assert encoding.decode_step(event.payload, T0_NS + 3) == ApplyResult(T0_NS + 3)


@pytest.mark.parametrize(
    "text", ['{"event": "mark", "text": "pause"}', '["pause"]', '{"event": ["pause"]}', "1"]
)
def test_other_events_are_no_requests(text):
    assert encoding.decode_step(encoding.encode_event(text, 1, 1).payload, 1) is None


@pytest.mark.parametrize("text", ["pause", "", "[" * 100_000])
def test_an_event_that_is_no_json_is_bad_input(text):
    with pytest.raises(InputError, match="an event that is no JSON"):
        encoding.decode_step(encoding.encode_event(text, 1, 1).payload, 1)


def test_log_times_rise_strictly_and_follow_the_clock():
    clock = LogClock()
    assert [clock.next_ns(t) for t in (10, 10, 5, 20)] == [10, 12, 14, 20]
