"""Bags are written here by rosbags' writers; their ROS 1 messages by rosbags' own definitions of Noetic."""

import json
import os
from collections.abc import Callable
from dataclasses import replace
from itertools import starmap
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from drivers.frames import ImuSample, LaserScan, OdometrySample
from service.cli import main
from service.encoding import LASER_SCAN, Message, encode_frame, schema_text
from service.errors import InputError, StorageError
from service.offline.importing.carmen import import_carmen
from service.offline.importing.rosbag import import_rosbag
from service.recording.mcap_source import open_session
from tests.service.recording.bags import OLD_TF, write_ros1, write_ros2
from tests.service.recording.sessions import MOUNTINGS, T0_NS, drive, pose_at, ranges_in_room, scan_message
from tests.soaked import in_soak

SCANS = 5
TOPICS = {"front/scan": "base_scan", "base/odom": "odom", "tf_static": "tf_static"}
IMU = ImuSample("imu", T0_NS, T0_NS, (0.0, 0.0, 0.5), (0.0, 0.1, 9.8))
DRIVE = [
    *(replace(message, channel=TOPICS[message.channel]) for message in drive(SCANS)),
    replace(encode_frame(IMU), channel="imu/data"),
]


def of_old_tf(message: Message) -> Message:
    """Mountings as ROS releases before 2012 sent them."""
    return replace(message, channel="tf", type=OLD_TF) if message.channel == "tf_static" else message


BAGS: dict[str, Callable[[Path], Path]] = {
    "ROS 1": lambda folder: write_ros1(folder / "drive.bag", DRIVE),
    "ROS 1, tf 1": lambda folder: write_ros1(folder / "drive.bag", map(of_old_tf, DRIVE)),
    "ROS 2": lambda folder: write_ros2(folder / "drive", DRIVE, StoragePlugin.MCAP),
}


@pytest.mark.parametrize("kind", BAGS)
def test_a_bag_becomes_a_session_with_its_sensors_and_mountings(kind, tmp_path, capsys):
    out = tmp_path / "out.mcap"
    assert main(["import", "rosbag", str(BAGS[kind](tmp_path)), str(out), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["frames"] == {
        "scans of base": SCANS,
        "IMU samples of imu_data": 1,
        "odometry samples of odom": SCANS,
    }
    assert facts["mountings"]["base"]["x_m"] == 0.2
    session = open_session([out])
    assert session.sensors == {"/base/scan": "base", "/imu_data/imu": "imu_data", "/odom/odom": "odom"}
    mounting = session.mountings["base"]
    assert (mounting.x_m, mounting.y_m) == (0.2, 0.0)
    assert mounting.theta_rad == pytest.approx(MOUNTINGS["front"].theta_rad)
    frames = list(session.frames())
    for k, scan in enumerate(frame for frame in frames if isinstance(frame, LaserScan)):
        expected = scan_message(k)
        assert (scan.stamp_ns, scan.arrived_ns) == (expected.stamp_ns, expected.log_ns)
        assert (scan.beam_interval_ns, scan.scan_period_ns) == (27_778, 20_000_000)
        np.testing.assert_array_equal(scan.range_m, ranges_in_room(k, 541))
    samples = [frame for frame in frames if isinstance(frame, OdometrySample)]
    assert [sample.x_m for sample in samples] == [pose_at(k).x_m for k in range(SCANS)]
    assert samples[0].twist_mps_radps == (0.5, 0.0, 0.05)
    assert [frame.rate_radps for frame in frames if isinstance(frame, ImuSample)] == [IMU.rate_radps]


def test_a_name_that_is_no_text_is_imported_with_escapes(tmp_path):
    bag = write_ros1(tmp_path / os.fsdecode(b"H\xe4lle.bag"), DRIVE)
    import_rosbag(bag, tmp_path / "out.mcap")
    assert open_session([tmp_path / "out.mcap"]).metadata["import"]["source"] == "H\\udce4lle.bag"


def test_a_bag_without_a_laser_is_refused_with_what_it_holds(tmp_path):
    bag = write_ros1(tmp_path / "drive.bag", [m for m in DRIVE if m.type != LASER_SCAN])
    holds = r"PointCloud2 that can be mapped; it holds /imu/data \(sensor_msgs/msg/Imu, 1\)"
    with pytest.raises(InputError, match=holds):
        import_rosbag(bag, tmp_path / "out.mcap")
    assert not list(tmp_path.glob("out*"))


@pytest.mark.parametrize(
    ("beams", "why"), [(541, "$"), (0, "; .*1 of 1 message cannot be used; of the first it")]
)
def test_a_bag_without_a_beam_that_came_back_is_refused(beams, why, tmp_path):
    frames = open_session([BAGS["ROS 1"](tmp_path)]).frames()
    scan = next(frame for frame in frames if isinstance(frame, LaserScan))
    blind = replace(scan, sensor="front", range_m=np.full(beams, 30.0, np.float32))
    bag = write_ros1(tmp_path / "blind.bag", [encode_frame(blind)])
    with pytest.raises(
        InputError, match=f"not one beam came back in all scans of front; nothing .* of it{why}"
    ):
        import_rosbag(bag, tmp_path / "out.mcap")
    assert not list(tmp_path.glob("out*"))


@pytest.mark.parametrize(
    "content", [b"", b"#ROSBAG V2.0\n", b"#ROSBAG V1.2\nx", b"SQLite format 3\0", b"\x89MCAP0\r\n"]
)
@pytest.mark.parametrize("suffix", [".bag", ".db3", ".mcap"])
def test_what_is_no_bag_is_refused_in_words(content, suffix, tmp_path):
    bag = tmp_path / f"broken{suffix}"
    bag.write_bytes(content)
    with pytest.raises(InputError, match="broken"):
        import_rosbag(bag, tmp_path / "out.mcap")
    assert not list(tmp_path.glob("out*"))


@pytest.mark.parametrize("importer", [import_rosbag, import_carmen])
def test_an_output_that_cannot_be_written_shows_before_the_input_is_read(importer, tmp_path):
    """A bag of an hour takes minutes to read."""
    (tmp_path / "in.mcap").write_bytes(b"no session at all")
    for out in (tmp_path, tmp_path / "in.mcap" / "out.mcap"):
        with pytest.raises(StorageError, match="cannot write"):
            importer(tmp_path / "in.mcap", out)


def test_a_scan_of_another_definition_is_passed_over(tmp_path):
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg("float32[] ranges", LASER_SCAN))
    raw = store.serialize_ros1(store.types[LASER_SCAN](ranges=np.ones(3, np.float32)), LASER_SCAN)
    with Ros1Writer(tmp_path / "other.bag") as writer:
        writer.write(writer.add_connection("/scan", LASER_SCAN, typestore=store), T0_NS, raw)
    with pytest.raises(InputError, match=r"passed over /scan .*another message of its name"):
        import_rosbag(tmp_path / "other.bag", tmp_path / "out.mcap")


def test_a_scan_of_another_definition_is_passed_over_in_an_mcap_too(tmp_path):
    """With the same fields in another order, whose bytes would be read as others."""
    a, b = "float32 range_min", "float32 range_max"
    swapped = schema_text(LASER_SCAN).replace(f"{a}\n{b}", f"{b}\n{a}")
    assert swapped != schema_text(LASER_SCAN)
    with (tmp_path / "other.mcap").open("wb") as stream:
        writer = McapWriter(stream)
        writer.start()
        schema = writer.register_schema(LASER_SCAN, "ros2msg", swapped.encode())
        channel = writer.register_channel("/scan", "cdr", schema)
        writer.add_message(channel, T0_NS, scan_message(0).payload, T0_NS)
        writer.finish()
    with pytest.raises(InputError, match=r"passed over /scan .*another message of its name"):
        import_rosbag(tmp_path / "other.mcap", tmp_path / "out.mcap")


REAL = [
    ("lms1xx_static", "sick_lms1xx.bag", 89, 0),
    ("people_static", "leg_stationary.bag", 1265, 0),
    ("pioneer_lgfloor", "soc_lgfloor2.bag", 1640, 1640),
]
REAL_IDS = [row[0] for row in REAL]


@pytest.mark.parametrize(
    ("name", "bag", "scans", "samples"), [REAL[0], *starmap(in_soak, REAL[1:])], ids=REAL_IDS
)
def test_real_bags_give_what_another_converter_made_of_them(
    shared: Path, tmp_path, name, bag, scans, samples
):
    folder = shared / "datasets" / name
    import_rosbag(folder / "raw" / bag, tmp_path / "out.mcap")
    ours = list(open_session([tmp_path / "out.mcap"]).frames())
    theirs = list(open_session([folder / f"{name}.mcap"]).frames())
    pairs = list(
        zip(
            (frame for frame in ours if isinstance(frame, LaserScan)),
            (frame for frame in theirs if isinstance(frame, LaserScan)),
            strict=True,
        )
    )
    assert len(pairs) == scans
    for scan, expected in pairs:
        assert scan.first_angle_rad == pytest.approx(expected.first_angle_rad)
        assert scan.angle_step_rad == pytest.approx(expected.angle_step_rad)
        came = np.isfinite(scan.range_m)
        np.testing.assert_allclose(scan.range_m[came], expected.range_m[came], atol=1e-5)
        assert not (expected.range_m[~came] > scan.range_min_m).any()  # the other one set no least range
    assert bool(samples) == any(isinstance(frame, OdometrySample) for frame in ours)
