"""Map and pose at which a killed service continues.

A file beside the maps holds both while the service runs, and is removed when it ends in good order.
"""

import logging
import os
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from pydantic import BaseModel, ValidationError

from service.config import ServiceConfig
from service.errors import CorridorError
from service.geometry.se2 import SE2
from service.mapper.profiles import begins_in_stored
from service.mapstore.begin_in import version_to_begin_in
from service.readable import read_text

log = logging.getLogger(__name__)

WRITE_S = 1.0


class Point(BaseModel):
    """Map and pose of a service, and its process."""

    folder: Path  # of its present map, which is stored
    unix_ns: int
    x_m: float  # pose_map_base
    y_m: float
    theta_rad: float
    pid: int = 0
    begun_ticks: int = 0  # of the process, since the boot: another one may have its number later

    @property
    def pose(self) -> SE2:
        return SE2(self.x_m, self.y_m, self.theta_rad)


def point_file(config: ServiceConfig) -> Path:
    directory: Path = config.sinks["map"].directory
    return directory / f".{config.vehicle}.resume.json"


def resumed(config: ServiceConfig) -> tuple[ServiceConfig, SE2 | None]:
    """The config of a session that goes on where one was killed at most map.resume_within_s ago, and the pose
    there; the same config and None where there is none, or where its map cannot be gone on in.
    """
    stored = config.sinks["map"]
    try:
        point = Point.model_validate_json(read_text(point_file(config)))
    except (OSError, CorridorError, ValidationError, ValueError):
        return config, None
    if point.pid != os.getpid() and point.begun_ticks and point.begun_ticks == _begun_ticks(point.pid):
        log.warning(
            "process %d is a service of %s, too, and stores its maps in %s: two write each other's maps and "
            "recordings there, and a new map begins; give one of them another `vehicle`, or end it",
            *(point.pid, config.vehicle, stored.directory),
        )
        return config, None
    age_s = time.time() - point.unix_ns / 1e9
    if not 0.0 <= age_s <= stored.resume_within_s or config.begin_in not in (None, point.folder):
        return config, None
    if config.begin_in is None:
        if not begins_in_stored(config.mapping):
            return config, None
        try:
            version_to_begin_in(point.folder, config.mapping)
        except CorridorError as error:
            log.warning("the map of %.0f s ago is not gone on in, a new one begins: %s", age_s, error)
            return config, None
        going_on = stored.model_copy(update={"load": point.folder})
        config = replace(config, begin_in=point.folder, sinks={**config.sinks, "map": going_on})
    log.warning(
        "the service was killed %.0f s ago; it goes on in %s near (%.2f, %.2f) m, %.2f rad",
        *(age_s, point.folder, point.x_m, point.y_m, point.theta_rad),
    )
    return config, point.pose


def _begun_ticks(pid: int) -> int:
    """When the process began, since the boot; 0: there is none, or it has ended."""
    try:
        stat = Path("/proc", str(pid), "stat").read_text(errors="replace")
    except OSError:
        return 0
    state, *fields = stat.rpartition(")")[2].split()
    return 0 if state == "Z" else int(fields[18])


class PointWriter:
    """Writes the file each WRITE_S, in a thread of its own: a disk may hang.

    now   where the service is; None: nothing is stored yet, or there is no pose
    """

    def __init__(self, path: Path, now: Callable[[], Point | None]) -> None:
        self._path = path
        self._part = path.with_name(f"{path.name}.{os.getpid()}")  # a full disk leaves it behind
        self._now = now
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="resume", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def stop(self, timeout_s: float) -> None:
        """Raises nothing; the file stays."""
        self._over.set()
        if self._thread.ident is not None:
            self._thread.join(timeout_s)

    def remove(self) -> None:
        """The service has ended in good order. Raises OSError."""
        for path in (self._path, self._part):
            path.unlink(missing_ok=True)

    def _run(self) -> None:
        fault, own = "", {"pid": os.getpid(), "begun_ticks": _begun_ticks(os.getpid())}
        while not self._over.wait(WRITE_S):
            if (point := self._now()) is None:
                continue
            try:
                self._part.write_text(point.model_copy(update=own).model_dump_json(), encoding="utf-8")
                self._part.rename(self._path)
                fault = ""
            except OSError as error:
                with suppress(OSError):
                    self._part.unlink(missing_ok=True)
                if str(error) != fault:
                    log.warning(
                        "%s cannot be written, a restart would begin a new map: %s", self._path, error
                    )
                fault = str(error)
