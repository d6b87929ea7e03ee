"""A drive whose laser sends echoes or point clouds is mapped like the same drive of LaserScans."""

import json
import math
from pathlib import Path

import numpy as np
import pytest

from drivers.frames import LaserScan
from service import encoding
from service.cli import main
from service.encoding import Message
from service.errors import InputError
from service.offline.past.driven_moments import ReplayedMoments
from service.offline.replay.replay import replay
from service.offline.replay.setup import ReplayOptions
from service.recording.mcap_source import open_session
from tests.service.conversion.messages import STORE, cloud, echoes
from tests.service.recording.bags import write_ros1, write_ros2
from tests.service.recording.foreign import Foreign, turn
from tests.service.recording.sessions import drive

SCANS = 25
DRIVE = drive(SCANS)


def as_echoes(m: Message) -> Message:
    """A pane of glass at half the range before each tenth beam; what is behind it is stronger."""
    scan = STORE.deserialize_cdr(m.payload, encoding.LASER_SCAN)
    ranges = [[r / 2.0, r] if k % 10 == 0 else [r] for k, r in enumerate(scan.ranges)]
    strength = [[10.0, 50.0][-len(beam) :] for beam in ranges]
    sweep = scan.angle_min, scan.angle_max, scan.angle_increment, scan.time_increment, scan.scan_time
    payload = echoes(ranges, strength, (*sweep, scan.range_min, scan.range_max), m.stamp_ns)
    return Message("echoes", encoding.MULTI_ECHO_SCAN, m.stamp_ns, m.log_ns, payload)


def as_cloud(m: Message, heights_m: tuple[float, ...] = (0.0,)) -> Message:
    """Points with times; of a 3-D laser walls at several heights, and in all directions what is too low."""
    scan = STORE.deserialize_cdr(m.payload, encoding.LASER_SCAN)
    angle = scan.angle_min + scan.angle_increment * np.arange(len(scan.ranges))
    t = scan.time_increment * np.arange(len(scan.ranges))
    rings = [(scan.ranges, z) for z in heights_m]
    if len(heights_m) > 1:
        rings.append((0.5, -0.5))
    rows = [(r * np.cos(angle), r * np.sin(angle), np.full_like(angle, z), t) for r, z in rings]
    columns = dict(zip(("x", "y", "z", "time"), np.concatenate(rows, axis=1), strict=True))
    return Message("points", encoding.POINT_CLOUD, m.stamp_ns, m.log_ns, cloud(columns, stamp_ns=m.stamp_ns))


def with_scans(change) -> list[Message]:
    return [change(m) if m.type == encoding.LASER_SCAN else m for m in DRIVE]


def end_of(path: Path) -> tuple[float, float, float]:
    done = replay([path], ReplayOptions())
    assert done.summary["scans"] == SCANS
    assert done.summary["unmounted"] == []
    assert done.summary["warnings"] == [] if "warnings" in done.summary else True
    pose = done.poses_map_base[-1]
    return pose.x_m, pose.y_m, math.degrees(pose.theta_rad)


@pytest.fixture(scope="module")
def expected(tmp_path_factory: pytest.TempPathFactory) -> tuple[float, float, float]:
    return end_of(write_ros1(tmp_path_factory.mktemp("scans") / "drive.bag", DRIVE))


@pytest.mark.parametrize("kind", ["echoes", "planar cloud", "3-D cloud"])
def test_it_ends_where_the_drive_of_scans_ends(kind: str, tmp_path: Path, expected):
    changes = {
        "echoes": as_echoes,
        "planar cloud": as_cloud,
        "3-D cloud": lambda m: as_cloud(m, (0.3, 0.6, 0.9)),
    }
    path = write_ros2(tmp_path / "drive", with_scans(changes[kind]))
    x_m, y_m, heading_deg = end_of(path)
    assert math.hypot(x_m - expected[0], y_m - expected[1]) < 0.01
    assert heading_deg == pytest.approx(expected[2], abs=0.1)


def test_config_names_topics_and_options_are_before_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path = write_ros2(tmp_path / "drive", with_scans(as_echoes))
    config = tmp_path / "c.yaml"
    config.write_text("replay: {scan_topics: [/nowhere], echo: first}\n")
    command = ["replay", str(path), "--config", str(config), "--out", str(tmp_path / "out"), "--json"]
    assert main(command) == 64
    assert "--scan-topic /nowhere: no such topic" in capsys.readouterr().err
    assert main([*command, "--scan-topic", "/echoes"]) == 0
    assert json.loads(capsys.readouterr().out)["scans"] == SCANS
    config.write_text("replay: {z_min_m: 1.0, z_max_m: 0.5}\n")
    assert main(command) == 78
    assert "c.yaml:1:1: replay: z_min_m (1) is not below z_max_m (0.5)" in capsys.readouterr().err


@pytest.mark.parametrize("change", [lambda m: m, as_echoes, as_cloud], ids=["scans", "echoes", "cloud"])
def test_a_page_shows_the_scans_of_a_bag_at_any_moment(change, tmp_path: Path):
    session = open_session([write_ros1(tmp_path / "drive.bag", with_scans(change))])
    scans = [frame for frame in session.frames() if isinstance(frame, LaserScan)]
    stamp_ns, log_ns = (np.array([getattr(scan, n) for scan in scans]) for n in ("stamp_ns", "arrived_ns"))
    moments = ReplayedMoments(session, stamp_ns, log_ns, np.zeros((len(scans), 3)))
    for k in (3, SCANS - 1):
        (shown,) = moments.at(int(stamp_ns[k])).scans
        assert shown.stamp_ns == scans[k].stamp_ns
        np.testing.assert_array_equal(shown.range_m, scans[k].range_m)


@pytest.mark.parametrize("heights_m", [(0.0,), (-2.0, 2.0)], ids=["planar", "3-D"])
def test_of_tilted_devices_only_a_3_d_one_is_mapped(heights_m: tuple[float, ...], tmp_path: Path):
    clouds = [as_cloud(m, heights_m) for m in DRIVE if m.type == encoding.LASER_SCAN]
    foreign = Foreign(tmp_path / "tilted.mcap").tf(("base_link", "front", (0.0, 0.0, 1.0), turn(pitch=20.0)))
    for m in clouds:
        foreign.add_message("/points", m)
    paths = foreign.close()
    if len(heights_m) == 1:
        with pytest.raises(InputError, match="tilted by 20 deg against base_link; at most 10 can be mapped"):
            open_session(paths)
    else:
        assert open_session(paths).scan_counts == {"points": SCANS}
