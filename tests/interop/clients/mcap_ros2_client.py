"""mcap-ros2-support (PyPI): every message of a session, decoded from the schemas that stand in the file."""

import math
from collections import Counter

from mcap_ros2.reader import read_ros2_messages
from reporting import expect, facts, report

MAX_RMSE_M = 0.05

truth = facts()
counts = Counter()
stamps_ns, poses = [], []
for message in read_ros2_messages(truth["mcap"]):
    counts[message.channel.topic] += 1
    if message.channel.topic == "/pose":
        stamp, pose = message.ros_msg.header.stamp, message.ros_msg.pose.pose
        stamps_ns.append(stamp.sec * 1_000_000_000 + stamp.nanosec)
        yaw = 2.0 * math.atan2(pose.orientation.z, pose.orientation.w)
        poses.append((pose.position.x, pose.position.y, yaw))
expect(dict(counts) == truth["counts"], f"{dict(counts)} messages, expected {truth['counts']}")
expect(stamps_ns == truth["stamps_ns"], "other stamps of poses")


def seen_from_first(track):
    x0, y0, theta0 = track[0]
    cosine, sine = math.cos(theta0), math.sin(theta0)
    return [(cosine * (x - x0) + sine * (y - y0), cosine * (y - y0) - sine * (x - x0)) for x, y, _ in track]


pairs = zip(seen_from_first(poses), seen_from_first(truth["true_poses"]), strict=True)
rmse_m = math.sqrt(sum(math.dist(a, b) ** 2 for a, b in pairs) / len(poses))
expect(rmse_m <= MAX_RMSE_M, f"poses {rmse_m:.3f} m off the truth, expected {MAX_RMSE_M} m at most")
report(messages=counts.total(), rmse_m=rmse_m)
