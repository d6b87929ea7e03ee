import json
import math
import struct
import zlib
from dataclasses import replace

import numpy as np
import pytest

from service.encoding import (
    Message,
    encode_diagnostics,
    encode_frame,
    encode_grid,
    encode_pose,
    encode_tf_static,
)
from service.geometry.se2 import SE2
from service.mapper.map_changes import NOTHING_CHANGED
from service.outputs import Grid
from service.web.live_view import SCAN_PERIOD_NS, DrivenPath, LiveView
from tests.browser.scene import MOUNTINGS, Scene, event, stamp, statuses


class Clock:
    ns = 0

    def __call__(self) -> int:
        return self.ns


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def view(clock):
    return LiveView(clock)


def texts(shown, kind):
    read = [json.loads(s.payload) for s in shown if isinstance(s.payload, str)]
    return [message for message in read if message["type"] == kind]


def keys(shown):
    return [s.key for s in shown]


def test_the_newest_of_each_is_shown_once(view):
    scene = Scene()
    for seconds in (0.0, 0.1):
        for message in scene.messages(seconds):
            view.put(message)
    shown = view.due()
    assert sorted(keys(shown)) == ["health", "mountings", "pose", "scan/front", "scan/rear"]
    (pose,) = texts(shown, "pose")
    assert pose["stamp_ns"] == str(stamp(0.1))
    assert (pose["x_m"], pose["y_m"]) == (scene.pose(0.1).x_m, scene.pose(0.1).y_m)
    assert view.due() == []


def test_a_laser_is_shown_five_times_a_second_with_its_newest_scan(view, clock):
    scene = Scene()
    stamps = []
    for tick in range(11):  # of 20 ms; a scan comes with each
        clock.ns = tick * 20_000_000
        view.put(encode_frame(scene.scan("front", tick * 0.02)))
        stamps += [struct.unpack_from("<d", s.payload, 4)[0] for s in view.due()]
    assert SCAN_PERIOD_NS == 200_000_000
    assert stamps == [pytest.approx(stamp(s) / 1e9, abs=1e-6) for s in (0.0, 0.2)]


def test_a_scan_of_a_laser_that_hangs_upside_down_is_turned_back(view):
    view.put(encode_tf_static(MOUNTINGS, 1, 1, upside_down=["front"]))
    view.due()
    view.put(encode_frame(Scene().scan("front", 0.0)))
    (shown,) = view.due()
    first, step = struct.unpack_from("<ff", shown.payload, 12)
    assert first == pytest.approx(math.pi / 2, abs=1e-6)
    assert step < 0.0


def test_health_says_since_when_it_is_so_whatever_its_words(view):
    def facts(seconds, state, reason):
        view.put(encode_diagnostics("diagnostics", statuses(state, reason), stamp(seconds), stamp(seconds)))
        (health,) = texts(view.due(), "health")
        return next(s["since_s"] for s in health["statuses"] if s["name"] == "mapping")

    assert facts(1, "ok", "") == stamp(1) / 1e9
    assert facts(2, "lost", "no agreement for 1 s") == stamp(2) / 1e9
    assert facts(3, "lost", "no agreement for 2 s") == stamp(2) / 1e9
    assert facts(4, "ok", "") == stamp(4) / 1e9


def test_a_late_browser_gets_the_path_and_a_map_reset_ends_it(view):
    scene = Scene()
    for seconds in (0.0, 0.01, 1.0, 2.0):  # the second is nearer than 5 cm
        view.put(encode_pose(scene.output(seconds), 1))
        view.due()

    def points():
        payload = next(s.payload for s in view.snapshot() if s.key == "path")
        return np.frombuffer(payload, "<f4", offset=8).reshape(-1, 2)

    expected = [(scene.pose(t).x_m, scene.pose(t).y_m) for t in (0.0, 1.0, 2.0)]
    np.testing.assert_allclose(points(), expected, atol=1e-6)
    reset, *_ = view.map_reset()
    assert struct.unpack_from("<I", reset.payload, 4) == (0,)
    assert len(points()) == 0


@pytest.mark.parametrize(("channel", "kind"), [("standing", 5), ("map/changes", 6)])
def test_a_layer_of_cells_is_shown_until_the_map_begins_again(view, channel, kind):
    cells = np.array([[-1, 5, 100], [7, -1, -1]], np.int8)
    view.put(encode_grid(Grid(0, 0.1, -1.2, 3.4, cells), 1, 1, channel))
    (shown,) = view.due()
    assert shown.key == channel
    begins, _, _, cell_m, column, row, width, height = struct.unpack_from("<BBHfiiII", shown.payload)
    assert (begins, round(cell_m, 6), column, row, width, height) == (kind, 0.1, -12, 34, 3, 2)
    assert np.frombuffer(zlib.decompress(shown.payload[24:]), np.int8).tolist() == cells.ravel().tolist()
    (emptied,) = [s for s in view.map_reset() if s.key == channel]
    assert struct.unpack_from("<II", emptied.payload, 16) == (0, 0)
    assert [s.payload for s in view.snapshot() if s.key == channel] == [emptied.payload]


def test_that_nothing_has_changed_differs_from_what_is_not_known(view):
    view.put(encode_grid(NOTHING_CHANGED, 2, 2, "map/changes"))
    (shown,) = view.due()
    *_, forgotten = view.map_reset()
    assert [struct.unpack_from("<BB", one.payload) for one in (shown, forgotten)] == [(6, 1), (6, 0)]


def test_a_long_path_keeps_its_shape_and_its_bound():
    path = DrivenPath(step_m=1.0, most=10)
    for metre in range(100):
        path.add(float(metre), 0.0)
    points = np.frombuffer(path.payload(), "<f4", offset=8).reshape(-1, 2)
    assert len(points) <= 10
    assert points[0].tolist() == [0.0, 0.0]
    assert points[-1, 0] >= 80.0
    assert np.ptp(np.diff(points[:, 0])) <= 16.0


def test_where_the_pose_jumps_another_stretch_of_path_begins(view):
    """As when a vehicle is found in a map that was loaded: no one drove straight there."""
    for seconds, x_m in ((1.0, 0.0), (1.1, 0.5), (1.2, 30.0), (1.3, 30.5), (4.0, 80.0)):
        pose = SE2(x_m, 0.0, 0.0)
        output = replace(Scene().output(seconds), pose_odom_base=pose, pose_map_odom=SE2())
        view.put(encode_pose(output, stamp(seconds)))
        view.due()
    nan = math.nan
    assert path_of(view) == pytest.approx([0.0, 0.5, nan, 30.0, 30.5, 80.0], nan_ok=True)  # 18 m/s at last
    view.map_reset()
    assert path_of(view) == []


def path_of(view):
    """x of its points, m."""
    payload = next(shown.payload for shown in view.snapshot() if shown.key == "path")
    return np.frombuffer(payload, "<f4", offset=8).reshape(-1, 2)[:, 0].tolist()


def test_bytes_that_are_no_pose_are_counted(view):
    view.put(Message("pose", "nav_msgs/msg/Odometry", 1, 1, b"\x00\x01\x00\x00"))
    assert view.due() == []
    assert view.unreadable == 1


def test_events_that_come_many_a_second_are_left_out(view):
    view.put(event('{"event": "apply_result"}', 0.0))
    view.put(event('{"event": "scan_passed_over", "sensor": "front"}', 0.0))
    marks = ['{"event": "mark", "text": "apply_result"}', "a door", "[" * 100_000]
    for text in marks:
        view.put(event(text, 0.0))
    assert [shown["text"] for shown in texts(view.due(), "event")] == marks


def test_what_is_ready_is_shown_as_it_is_and_kept_for_who_comes_late(view):
    view.put_ready({"moment": "first", "path": b"whole"})
    view.put_ready({"moment": "second"})
    assert [(s.key, s.payload) for s in view.due()] == [("moment", "second"), ("path", b"whole")]
    assert view.due() == []
    assert [s.payload for s in view.snapshot() if s.key == "path"][-1] == b"whole"
