"""mcap-ros2-support (PyPI): every message of a session, decoded from the schemas that stand in the file."""

import math
from collections import Counter

from mcap_ros2.reader import read_ros2_messages
from telling import expect, facts, tell

MAX_RMSE_M = 0.05

truth = facts()
samples = {(sample["topic"], sample["nth"]): sample for sample in truth["samples"]}
counts = Counter()
poses = []


def stamp_ns(header):
    return header.stamp.sec * 1_000_000_000 + header.stamp.nanosec


def yaw(q):
    return math.atan2(2.0 * (q.w * q.z + q.x * q.y), q.w * q.w + q.x * q.x - q.y * q.y - q.z * q.z)


def planar(pose):
    return [pose.position.x, pose.position.y, yaw(pose.orientation)]


def near(got, expected, what, slack=1e-9):
    got, expected = list(got), list(expected)
    close = len(got) == len(expected) and all(abs(a - b) <= slack for a, b in zip(got, expected, strict=True))
    expect(close, f"{what}: {got[:9]}, expected {expected[:9]}")


def compare(ros, sample, what):
    """One message against what the other side read in it."""
    if "stamp_ns" in sample:
        expect(stamp_ns(ros.header) == sample["stamp_ns"], f"{what}: stamp {ros.header.stamp}")
    if sample["kind"] == "scan":
        near((ros.angle_min, ros.angle_increment), (sample["first_rad"], sample["step_rad"]), what)
        near((ros.time_increment,), (sample["beam_interval_s"],), what)
        ranges = [r if math.isfinite(r) else None for r in ros.ranges]
        expect(ranges == sample["range_m"], f"{what}: other ranges")
    elif sample["kind"] == "imu":
        near(
            (ros.angular_velocity.x, ros.angular_velocity.y, ros.angular_velocity.z),
            sample["rate_radps"],
            what,
        )
        expect((ros.orientation_covariance[0] != -1.0) == sample["oriented"], f"{what}: orientation")
    elif sample["kind"] == "fix":
        near((ros.latitude, ros.longitude, ros.altitude), sample["place"], what)
    elif sample["kind"] == "map":
        expect([ros.info.height, ros.info.width] == sample["shape"], f"{what}: {ros.info}")
        near((ros.info.origin.position.x, ros.info.origin.position.y), sample["origin_m"], what)
        near((ros.info.resolution,), (sample["cell_m"],), what, 1e-6)
        expect(list(ros.data) == sample["cells"], f"{what}: other cells")
    elif sample["kind"] == "mountings":
        found = {
            edge.child_frame_id: (
                edge.transform.translation.x,
                edge.transform.translation.y,
                yaw(edge.transform.rotation),
            )
            for edge in ros.transforms
        }
        expect(found.keys() == sample["mountings"].keys(), f"{what}: {sorted(found)}")
        for name, mounting in sample["mountings"].items():
            near(found[name], mounting, f"{what} of {name}")
    else:
        near(planar(ros.pose.pose), sample["pose"], what)
        twist = ros.twist.twist
        near((twist.linear.x, twist.linear.y, twist.angular.z), sample["twist"], what)
        if "frames" in sample:
            expect([ros.header.frame_id, ros.child_frame_id] == sample["frames"], f"{what}: frames")


compared = 0
for message in read_ros2_messages(truth["mcap"]):
    topic = message.channel.topic
    sample = samples.get((topic, counts[topic]))
    if sample is not None:
        what = f"{topic} number {counts[topic]}"
        expect(message.log_time_ns == sample["log_ns"], f"{what}: logged at {message.log_time_ns}")
        compare(message.ros_msg, sample, what)
        compared += 1
    counts[topic] += 1
    if topic == "/pose":
        poses.append(planar(message.ros_msg.pose.pose))
expect(dict(counts) == truth["counts"], f"{dict(counts)} messages, expected {truth['counts']}")
expect(compared == len(samples) > 0, f"{compared} of {len(samples)} compared")


def seen_from_first(track):
    x0, y0, theta0 = track[0]
    cosine, sine = math.cos(theta0), math.sin(theta0)
    return [(cosine * (x - x0) + sine * (y - y0), cosine * (y - y0) - sine * (x - x0)) for x, y, _ in track]


pairs = zip(seen_from_first(poses), seen_from_first(truth["true_poses"]), strict=True)
rmse_m = math.sqrt(sum(math.dist(a, b) ** 2 for a, b in pairs) / len(poses))
expect(rmse_m <= MAX_RMSE_M, f"poses {rmse_m:.3f} m off the truth, expected {MAX_RMSE_M} m at most")
tell(messages=counts.total(), rmse_m=rmse_m)
