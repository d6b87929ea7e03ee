"""Bags are written here by rosbags' writers; their ROS 1 messages by rosbags' own definitions of Noetic."""

import json
import math
from dataclasses import dataclass
from itertools import starmap
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from drivers.frames import ImuSample, LaserScan, OdometrySample
from service.cli import main
from service.errors import InputError, StorageError
from service.offline.importing.carmen import import_carmen
from service.offline.importing.rosbag import import_rosbag
from service.recording.mcap_source import open_session
from tests.soaked import in_soak

T0_NS = 1_700_000_000_000_000_000
SCANS = 5
TF_1 = "tf/msg/tfMessage"
EDGE_OF_FRONT = ("base_link", "laser", (0.25, 0.05, 0.1), math.radians(30.0))


def ranges_of(index):
    return np.linspace(1.0, 2.0 + index, 181, dtype=np.float32)


@dataclass
class Dialect:
    """Makes messages as one ROS release has them."""

    store: object
    ros1: bool

    def message(self, name, **fields):
        return self.store.types[name](**fields)

    def header(self, stamp_ns, frame):
        stamp = self.message("builtin_interfaces/msg/Time", sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
        seq = {"seq": 7} if self.ros1 else {}
        return self.message("std_msgs/msg/Header", stamp=stamp, frame_id=frame, **seq)

    def vector(self, x, y, z):
        return self.message("geometry_msgs/msg/Vector3", x=x, y=y, z=z)

    def quaternion(self, yaw):
        half = yaw / 2
        return self.message("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=math.sin(half), w=math.cos(half))

    def scan(self, index, ranges=None):
        return self.message(
            "sensor_msgs/msg/LaserScan",
            header=self.header(T0_NS + index * 100_000_000, "laser"),
            angle_min=-math.pi / 2,
            angle_max=math.pi / 2,
            angle_increment=math.pi / 180,
            time_increment=0.0001,
            scan_time=0.1,
            range_min=0.1,
            range_max=30.0,
            ranges=ranges_of(index) if ranges is None else ranges,
            intensities=np.zeros(0, dtype=np.float32),
        )

    def imu(self, index):
        unknown = np.zeros(9)
        return self.message(
            "sensor_msgs/msg/Imu",
            header=self.header(T0_NS + index * 100_000_000 + 1, "imu"),
            orientation=self.quaternion(0.1),
            orientation_covariance=unknown,
            angular_velocity=self.vector(0.0, 0.0, 0.5 + index),
            angular_velocity_covariance=unknown,
            linear_acceleration=self.vector(0.0, 0.1, 9.8),
            linear_acceleration_covariance=unknown,
        )

    def odometry(self, index):
        pose = self.message(
            "geometry_msgs/msg/Pose",
            position=self.message("geometry_msgs/msg/Point", x=0.1 * index, y=-0.2, z=0.0),
            orientation=self.quaternion(0.3),
        )
        twist = self.message(
            "geometry_msgs/msg/Twist", linear=self.vector(1.0, 0.0, 0.0), angular=self.vector(0.0, 0.0, 0.2)
        )
        return self.message(
            "nav_msgs/msg/Odometry",
            header=self.header(T0_NS + index * 100_000_000 + 2, "odom"),
            child_frame_id="base_link",
            pose=self.message("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=np.zeros(36)),
            twist=self.message("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.zeros(36)),
        )

    def tf(self, type_name, stamp_ns, *edges):
        transforms = [
            self.message(
                "geometry_msgs/msg/TransformStamped",
                header=self.header(stamp_ns, f"/{parent}" if type_name == TF_1 else parent),
                child_frame_id=child,
                transform=self.message(
                    "geometry_msgs/msg/Transform",
                    translation=self.vector(*xyz),
                    rotation=self.quaternion(yaw),
                ),
            )
            for parent, child, xyz, yaw in edges
        ]
        return self.message(type_name, transforms=transforms)


def noetic():
    store = get_typestore(Stores.ROS1_NOETIC)
    for name in (TF_1, TF_2):  # not in rosbags' Noetic
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", name))
    return Dialect(store, ros1=True)


def humble():
    return Dialect(get_typestore(Stores.ROS2_HUMBLE), ros1=False)


TF_2 = "tf2_msgs/msg/TFMessage"
SCAN, IMU, ODOM = "sensor_msgs/msg/LaserScan", "sensor_msgs/msg/Imu", "nav_msgs/msg/Odometry"


def drive(dialect, static=("/tf_static", TF_2)):
    """(topic, type, time, message) of a short drive with a laser, wheels and an IMU."""
    topic, tf_type = static
    rows = [(topic, tf_type, T0_NS, dialect.tf(tf_type, T0_NS, EDGE_OF_FRONT))]
    for k in range(SCANS):
        log_ns = T0_NS + k * 100_000_000 + 5_000_000
        rows += [
            ("/base_scan", SCAN, log_ns, dialect.scan(k)),
            ("/imu/data", IMU, log_ns + 1, dialect.imu(k)),
            ("/odom", ODOM, log_ns + 2, dialect.odometry(k)),
        ]
    return rows


def write_ros1(path, rows, store=None):
    store = store or noetic().store
    with Ros1Writer(path) as writer:
        known = {}
        for topic, type_name, log_ns, message in rows:
            if topic not in known:
                known[topic] = writer.add_connection(topic, type_name, typestore=store)
            writer.write(known[topic], log_ns, store.serialize_ros1(message, type_name))
    return path


def write_ros2(path, rows, plugin=StoragePlugin.SQLITE3):
    store = humble().store
    with Ros2Writer(path, version=9, storage_plugin=plugin) as writer:
        known = {}
        for topic, type_name, log_ns, message in rows:
            if topic not in known:
                known[topic] = writer.add_connection(topic, type_name, typestore=store)
            writer.write(known[topic], log_ns, store.serialize_cdr(message, type_name))
    return path


BAGS = {
    "ROS 1": lambda folder: write_ros1(folder / "drive.bag", drive(noetic())),
    "ROS 1, tf 1": lambda folder: write_ros1(folder / "drive.bag", drive(noetic(), ("/tf", TF_1))),
    "ROS 2, db3": lambda folder: write_ros2(folder / "drive", drive(humble())),
    "ROS 2, a db3 without its folder": lambda folder: next(
        write_ros2(folder / "drive", drive(humble())).glob("*.db3")
    ),
    "ROS 2, mcap": lambda folder: write_ros2(folder / "drive", drive(humble()), StoragePlugin.MCAP),
    "ROS 2, an mcap without its folder": lambda folder: next(
        write_ros2(folder / "drive", drive(humble()), StoragePlugin.MCAP).glob("*.mcap")
    ),
}


@pytest.mark.parametrize("kind", BAGS)
def test_a_bag_becomes_a_session_with_its_sensors_and_mountings(kind, tmp_path):
    report = import_rosbag(BAGS[kind](tmp_path), tmp_path / "out.mcap")
    assert report.frames == {
        "scans of base": SCANS,
        "IMU samples of imu_data": SCANS,
        "odometry samples of odom": SCANS,
    }
    session = open_session([tmp_path / "out.mcap"])
    assert session.sensors == {"/base/scan": "base", "/imu_data/imu": "imu_data", "/odom/odom": "odom"}
    mounting = session.mountings["base"]
    assert (mounting.x_m, mounting.y_m) == (0.25, 0.05)
    assert math.degrees(mounting.theta_rad) == pytest.approx(30.0)
    frames = list(session.frames())
    scans = [frame for frame in frames if isinstance(frame, LaserScan)]
    for k, scan in enumerate(scans):
        assert (scan.stamp_ns, scan.arrived_ns) == (T0_NS + k * 10**8, T0_NS + k * 10**8 + 5_000_000)
        assert (scan.beam_interval_ns, scan.scan_period_ns) == (100_000, 100_000_001)  # as float32 has 0.1 s
        np.testing.assert_array_equal(scan.range_m, ranges_of(k))
    samples = [frame for frame in frames if isinstance(frame, OdometrySample)]
    assert [sample.x_m for sample in samples] == [0.1 * k for k in range(SCANS)]
    assert samples[0].twist_mps_radps == (1.0, 0.0, 0.2)
    assert [f.rate_radps[2] for f in frames if isinstance(f, ImuSample)] == [0.5 + k for k in range(SCANS)]


def test_an_import_reports_as_json_what_it_counted(tmp_path, capsys):
    bag = BAGS["ROS 1"](tmp_path)
    assert main(["import", "rosbag", str(bag), str(tmp_path / "out.mcap"), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["frames"]["scans of base"] == SCANS
    assert facts["mountings"]["base"]["x_m"] == 0.25


def test_a_bag_without_odometry_gives_that_of_its_tf(tmp_path):
    ros = noetic()
    rows = [row for row in drive(ros, ("/tf", TF_1)) if row[0] != "/odom"]
    for k in range(SCANS):
        stamp_ns = T0_NS + k * 100_000_000
        edge = ("odom", "base_link", (0.5 * k, 1.0, 0.0), 0.1 * k)
        rows.append(("/tf", TF_1, stamp_ns + 7, ros.tf(TF_1, stamp_ns, EDGE_OF_FRONT, edge)))
    import_rosbag(write_ros1(tmp_path / "old.bag", rows), tmp_path / "out.mcap")
    session = open_session([tmp_path / "out.mcap"])
    assert session.mountings["base"].x_m == 0.25
    samples = [frame for frame in session.frames() if isinstance(frame, OdometrySample)]
    assert [(s.stamp_ns, s.x_m, s.y_m) for s in samples] == [
        (T0_NS + k * 10**8, 0.5 * k, 1.0) for k in range(SCANS)
    ]
    assert [s.theta_rad for s in samples] == pytest.approx([0.1 * k for k in range(SCANS)])


def test_an_import_tells_of_covariances_that_are_none(tmp_path):
    ros = humble()
    rows = drive(ros)
    for topic, _, _, message in rows:
        if topic == "/odom":
            message.pose.covariance[:] = np.nan
    report = import_rosbag(write_ros2(tmp_path / "bag", rows), tmp_path / "out.mcap")
    assert report.frames["odometry samples of odom"] == SCANS
    assert f"/odom: the covariance of {SCANS} of {SCANS} messages is none" in str(report)


def test_a_bag_without_a_laser_is_refused_with_what_it_holds(tmp_path, capsys):
    rows = [row for row in drive(noetic()) if row[1] != SCAN]
    bag = write_ros1(tmp_path / "drive.bag", rows)
    assert main(["import", "rosbag", str(bag), str(tmp_path / "out.mcap")]) == InputError.exit_code
    said = capsys.readouterr().err
    assert (
        "sensor_msgs/msg/PointCloud2 that can be mapped; it holds /imu/data (sensor_msgs/msg/Imu, 5)" in said
    )
    assert not list(tmp_path.glob("out*"))


def test_a_bag_without_a_beam_that_came_back_is_refused(tmp_path):
    ros = noetic()
    nothing = np.full(181, 30.0, dtype=np.float32)
    bag = write_ros1(tmp_path / "drive.bag", [("/scan", SCAN, T0_NS, ros.scan(0, nothing))])
    with pytest.raises(InputError, match="not one beam came back in all scans of scan"):
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


@pytest.mark.parametrize("path", ["nowhere.bag", "nowhere", "empty"])
def test_a_missing_bag_is_named(path, tmp_path):
    (tmp_path / "empty").mkdir()
    why = "no recording in this folder" if path == "empty" else ""
    with pytest.raises(InputError, match=f"{path}.*{why}"):
        import_rosbag(tmp_path / path, tmp_path / "out.mcap")


def test_a_scan_of_another_definition_is_passed_over(tmp_path):
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg("float32[] ranges", SCAN))
    message = store.types[SCAN](ranges=ranges_of(0))
    bag = write_ros1(tmp_path / "other.bag", [("/scan", SCAN, T0_NS, message)], store)
    with pytest.raises(InputError, match=r"passed over /scan .*another message of its name"):
        import_rosbag(bag, tmp_path / "out.mcap")


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
