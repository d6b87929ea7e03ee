"""Readers of recordings: an independent CDR decoder, and a viewer's checker."""

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from drivers.frames import GnssFix, ImuSample, LaserScan, OdometrySample
from service.encoding import Message, decode_frame
from service.encoding.outputs import decode_grid, decode_mountings, decode_pose
from service.recording.mcap_reader import Recording
from tests.interop.programs import InteropError, Venv, run, run_client
from tests.interop.session import session

EVERY = 20  # th message of a topic is compared value by value
STATUS_OK = "ok"


def run_mcap_ros2(venv: Venv, folder: Path) -> str:
    drive = session(folder)
    counts: Counter[str] = Counter()
    samples: list[dict[str, Any]] = []
    stamps_ns: list[int] = []
    for message in Recording([drive.mcap]).messages():
        topic = f"/{message.channel}"
        if topic == "/pose":
            stamps_ns.append(decode_pose(message.payload).stamp_ns)
        if counts[topic] % EVERY == 0 and (values := _values(message)) is not None:
            samples.append({"topic": topic, "nth": counts[topic], "log_ns": message.log_ns, **values})
        counts[topic] += 1
    facts = {
        "mcap": str(drive.mcap),
        "counts": counts,
        "samples": samples,
        "true_poses": [(pose.x_m, pose.y_m, pose.theta_rad) for pose in drive.true_poses(stamps_ns)],
    }
    seen = run_client(venv, "mcap_ros2_client.py", facts, folder)
    return (
        f"{seen['messages']} messages on {len(counts)} topics decoded, {len(samples)} compared by value, "
        f"poses {1000 * seen['rmse_m']:.1f} mm off the truth"
    )


def run_rerun(venv: Venv, folder: Path) -> str:
    drive = session(folder)
    home = folder / "rerun-home"
    home.mkdir(exist_ok=True)
    rerun = str(venv.bin / "rerun")
    run([rerun, "analytics", "disable"], home)
    table = run([rerun, "mcap", "check", "--full", str(drive.mcap)], home)
    rows = {cells[3]: cells for cells in map(str.split, table.splitlines()) if len(cells) >= 4}
    topics = [topic.name for topic in Recording([drive.mcap]).topics]
    bad = [topic for topic in topics if rows.get(topic, ("",))[0] != STATUS_OK]
    if bad:
        raise InteropError(f"rerun mcap check does not call {', '.join(bad)} ok:\n{table}")
    return f"mcap check --full calls all {len(topics)} topics ok"


def _values(message: Message) -> dict[str, Any] | None:
    """What our own decoder reads in it; None for a type that the mapper has no use for."""
    match message.channel:
        case "pose" | "odom":
            pose = decode_pose(message.payload)
            return {
                "kind": "pose",
                "stamp_ns": pose.stamp_ns,
                "frames": [pose.frame, pose.child],
                "pose": [pose.pose.x_m, pose.pose.y_m, pose.pose.theta_rad],
                "twist": list(pose.twist),
            }
        case "map":
            grid = decode_grid(message.payload)
            return {
                "kind": "map",
                "shape": list(grid.cells.shape),
                "origin_m": [grid.x_min_m, grid.y_min_m],
                "cell_m": grid.cell_m,
                "cells": grid.cells.ravel().tolist(),
            }
        case "tf_static":
            mountings = decode_mountings(message.payload)
            return {
                "kind": "mountings",
                "mountings": {n: [m.x_m, m.y_m, m.theta_rad] for n, m in mountings.items()},
            }
    frame = decode_frame(message.type, message.payload, message.channel, message.log_ns)
    match frame:
        case LaserScan():
            return {
                "kind": "scan",
                "stamp_ns": frame.stamp_ns,
                "first_rad": frame.first_angle_rad,
                "step_rad": frame.angle_step_rad,
                "beam_interval_s": frame.beam_interval_ns * 1e-9,
                "range_m": [None if np.isnan(r) else float(r) for r in frame.range_m],
            }
        case ImuSample():
            return {
                "kind": "imu",
                "stamp_ns": frame.stamp_ns,
                "rate_radps": frame.rate_radps,
                "oriented": frame.orientation_wxyz is not None,
            }
        case OdometrySample():
            return {
                "kind": "wheels",
                "stamp_ns": frame.stamp_ns,
                "pose": [frame.x_m, frame.y_m, frame.theta_rad],
                "twist": list(frame.twist_mps_radps),
            }
        case GnssFix():
            return {
                "kind": "fix",
                "stamp_ns": frame.stamp_ns,
                "place": [frame.latitude_deg, frame.longitude_deg, frame.altitude_m],
            }
    return None
