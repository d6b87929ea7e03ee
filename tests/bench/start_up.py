"""From `corridor run` to the first pose on Zenoh, with no kernel in the cache and with all of them."""

import os
import tempfile
import time
from pathlib import Path
from unittest.mock import patch

from tests.system.machine import FakeVehicle, LiveService, Subscriber


def measure() -> list[tuple[str, float, str]]:
    with tempfile.TemporaryDirectory() as folder:
        vehicle = FakeVehicle(Path(folder), stand_s=1e6)
        vehicle.start()
        try:
            with patch.dict(os.environ, NUMBA_CACHE_DIR=str(Path(folder) / "kernels")):
                took_s = {
                    cache: _to_first_pose_s(Path(folder) / cache, vehicle) for cache in ("cold", "warm")
                }
        finally:
            vehicle.stop()
    return [(f"to the first pose, {cache} cache", seconds, "s") for cache, seconds in took_s.items()]


def _to_first_pose_s(folder: Path, vehicle: FakeVehicle) -> float:
    folder.mkdir()
    service = LiveService(folder, vehicle.sensors())
    began_s = time.monotonic()
    try:
        service.start(watchdog_s=10.0)
        subscriber = Subscriber(service.endpoint)
        try:
            subscriber.wait_for("pose", 1)
            return time.monotonic() - began_s
        finally:
            subscriber.close()
    finally:
        service.close()
