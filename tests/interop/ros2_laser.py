"""A foreign ROS 2 node as laser: its scans against the same scans read by our driver."""

import math
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path

import numpy as np

from drivers.frames import LaserScan
from service.encoding import decode_frame, decode_pose
from service.geometry.se2 import SE2
from service.recording.mcap_reader import Recording
from tests.interop.programs import InteropError, Venv, started_client
from tests.system.machine import FakeVehicle, LiveService

DOMAIN = 7
STAND_S, DRIVE_S = 25.0, 12.0
MIN_PATH_LENGTH_M = 1.0
ALIKE_M = 0.005


def run_sdk_laser(venv: Venv, folder: Path) -> str:
    """A node of the SDK's publishes the scans that our driver reads; a second service maps them as its laser.

    The vehicle stands until both map, so that both maps begin at the same place.
    """
    ours, theirs = folder / "ours", folder / "theirs"
    ours.mkdir()
    theirs.mkdir()
    vehicle = FakeVehicle(ours, stand_s=STAND_S)
    vehicle.start()
    drives_s = time.monotonic() + STAND_S
    laser = vehicle.sensors()["front"]
    first = LiveService(ours, {"front": laser}, ros2={"enabled": True, "domain": DOMAIN})
    topic = {"type": "ros2_scan", "topic": "/relayed/scan", "router": first.endpoint, "domain": DOMAIN}
    second = LiveService(theirs, {"front": {**topic, "mounting": laser["mounting"]}})
    try:
        first.start()
        with _relay(venv, theirs, first.endpoint):
            second.start()
            if time.monotonic() > drives_s:
                raise InteropError(f"the services took more than {STAND_S:.0f} s to start")
            threading.Event().wait(drives_s + DRIVE_S - time.monotonic())
            for live in (second, first):
                live.signal(signal.SIGTERM)
                if live.wait() != 0:
                    raise InteropError(f"corridor run ended badly:\n{live.log[-1500:]}")
    finally:
        second.close()
        first.close()
        vehicle.stop()
    return _compare(_poses_by_scan(first.sessions), _poses_by_scan(second.sessions))


@contextmanager
def _relay(venv: Venv, folder: Path, endpoint: str) -> Iterator[None]:
    """The foreign node."""
    port = int(endpoint.rpartition(":")[2])
    facts = {"port": port, "domain": DOMAIN, "from": "/front/scan", "to": "/relayed/scan"}
    with started_client(venv, "zenoh_ros2_sdk_relay.py", facts, folder) as (_, _, stdout):
        if stdout.readline() != "relays\n":
            raise InteropError("the relay does not start")
        yield


def _poses_by_scan(sessions: Path) -> dict[bytes, SE2]:
    """Ranges of each scan -> the pose that was published for it; in the order of the scans."""
    (session,) = sessions.glob("*.mcap")
    ranges: dict[int, bytes] = {}  # by stamp
    poses: dict[bytes, SE2] = {}
    for message in Recording([session]).messages(["/front/scan", "/pose"]):
        if message.channel == "pose":
            pose = decode_pose(message.payload)
            poses[ranges[pose.stamp_ns]] = pose.pose
        else:
            scan = decode_frame(message.type, message.payload, "front", message.log_ns)
            assert isinstance(scan, LaserScan)
            ranges[scan.stamp_ns] = scan.range_m.tobytes()
    return poses


def _compare(ours: dict[bytes, SE2], theirs: dict[bytes, SE2]) -> str:
    """Raises InteropError where they are not alike."""
    pairs = [(ours[scan], pose) for scan, pose in theirs.items() if scan in ours]
    off_m = np.array([math.hypot(a.x_m - b.x_m, a.y_m - b.y_m) for a, b in pairs])
    path_length_m = sum(math.hypot(b.x_m - a.x_m, b.y_m - a.y_m) for (a, _), (b, _) in pairwise(pairs))
    rmse_m = float(np.sqrt((off_m**2).mean())) if pairs else math.nan
    if not (rmse_m < ALIKE_M and path_length_m > MIN_PATH_LENGTH_M):
        raise InteropError(
            f"{len(pairs)} scans over {path_length_m:.1f} m, poses {1000 * rmse_m:.1f} mm apart"
        )
    return (
        f"{len(pairs)} scans over {path_length_m:.1f} m, poses {1000 * rmse_m:.1f} mm (RMS; at most "
        f"{1000 * off_m.max():.1f} mm) from those of the same scans by our driver"
    )
