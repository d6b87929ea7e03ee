"""Programs that know rmw_zenoh's layout without ROS, against the service with publishing.ros2."""

import json
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from drivers.rmw_zenoh import Topic, dds_type
from service.encoding import DIAGNOSTICS, LASER_SCAN, OCCUPANCY_GRID, ODOMETRY, TF, type_hash
from service.encoding.ros_services import LOAD_MAP, SAVE_MAP, TRIGGER, service_hash
from tests.interop.programs import TAIL_CHARS, InteropError, Venv, run_client, started_client
from tests.system.machine import FakeVehicle, LiveService

DOMAIN = 7
BACK_S = 2.0  # after a restart
RELIABLE = ["RELIABLE", "VOLATILE", 10]
LATCHED = ["RELIABLE", "TRANSIENT_LOCAL", 1]
TOPICS: dict[str, list[Any]] = {
    "/front/scan": [LASER_SCAN, RELIABLE],
    "/base/odom": [ODOMETRY, RELIABLE],
    "/pose": [ODOMETRY, RELIABLE],
    "/odom": [ODOMETRY, RELIABLE],
    "/tf": [TF, ["RELIABLE", "VOLATILE", 100]],
    "/tf_static": [TF, LATCHED],
    "/map": [OCCUPANCY_GRID, LATCHED],
    "/diagnostics": [DIAGNOSTICS, RELIABLE],
}
SERVICES = {
    **{f"/corridor/{name}": TRIGGER for name in ("pause", "resume", "save", "reset")},
    "/corridor/load_map": LOAD_MAP,
    "/corridor/save_map": SAVE_MAP,
}


def run_sdk(venv: Venv, folder: Path) -> str:
    """It lists, subscribes and calls, and goes on when the service, which is its router, is restarted."""
    with _machine(folder / "own") as service:
        port = int(service.endpoint.rpartition(":")[2])

        def restart() -> None:
            service.close_process()
            service.start()

        seen = _run_client(venv, {"port": port}, folder / "own", restart)
    return (
        f"{len(TOPICS)} topics and {len(SERVICES)} services with types, hashes and QoS, "
        f"{seen['messages']} messages decoded, late joiner's /map of {seen['known']} known cells after "
        f"{seen['late_s']:.1f} s, commands, pose; service restarted: back {seen['back_s']:.1f} s after ready"
    )


@contextmanager
def _machine(folder: Path) -> Iterator[LiveService]:
    """Fake devices and a service that maps."""
    folder.mkdir()
    vehicle = FakeVehicle(folder)
    vehicle.start()
    service = LiveService(folder, vehicle.sensors(), ros2={"enabled": True, "domain": DOMAIN})
    try:
        service.start()
        yield service
    finally:
        service.close()
        vehicle.stop()


def _run_client(
    venv: Venv, facts: dict[str, Any], folder: Path, restart: Callable[[], None]
) -> dict[str, Any]:
    """Values seen by the client, which goes on through one restart. Raises InteropError."""
    facts = {"domain": DOMAIN, "topics": TOPICS, "services": SERVICES, **facts}
    lines: list[str] = []
    again_s = 0.0
    script = "zenoh_ros2_sdk_client.py"
    with started_client(venv, script, facts, folder, subprocess.STDOUT) as (process, stdin, stdout):
        for line in stdout:
            lines.append(line)
            if line == "restart\n":
                restart()
                again_s = time.time()
                stdin.write("\n")
                stdin.flush()
        if process.wait() != 0:
            raise InteropError(f"it ended with {process.returncode}:\n{''.join(lines)[-TAIL_CHARS:]}")
    seen: dict[str, Any] = json.loads(lines[-1])
    late = {topic: at_s - again_s for topic, at_s in seen.pop("back_at_s").items()}
    seen["back_s"] = max(0.0, *late.values())
    if seen["back_s"] > BACK_S:
        raise InteropError(f"seconds until topics were back: {late}")
    return seen


def run_pamoja(venv: Venv, folder: Path) -> str:
    names = [
        *((name, kind, type_hash(kind)) for name, (kind, _) in TOPICS.items()),
        *((name, kind, service_hash(kind)) for name, kind in SERVICES.items()),
    ]
    facts = {
        "domain": DOMAIN,
        "names": [
            {
                "name": name,
                "type": kind,
                "hash": type_hash_text,
                "dds_type": dds_type(kind),
                "key": Topic(name, kind, type_hash_text).key(DOMAIN),
                "mangled": name.replace("/", "%"),
            }
            for name, kind, type_hash_text in names
        ],
    }
    seen = run_client(venv, "pamoja_ros2_client.py", facts, folder)
    return f"{seen['names']} topics and services: names, types, hashes and keys as rmw_zenoh has them"
