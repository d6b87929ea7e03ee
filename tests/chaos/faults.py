"""Faults of a drive. Each function here makes the `act` of a row, or is its `place`.

Each sleep is as long as its fault lasts, or is the time from one kill to the next.
"""

import os
import signal
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from tests.chaos.drive import Drive
from tests.processes import resident_mb
from tests.system.machine import PATIENCE_S, Subscriber, free_port

Act = Callable[[Drive], object]
Place = Callable[[Path], AbstractContextManager[dict[str, Any]]]  # of the drive's folder -> settings

WALL_CLOCK = "wall_clock"  # in a drive's folder, see wall_clock.c
MEMORY = Path("/sys/fs/cgroup/memory")
DISK_MB = 300
ROUTER = """
import sys, threading, zenoh
config = zenoh.Config()
for key, value in (("mode", '"router"'), ("listen/endpoints", f'["{sys.argv[1]}"]'),
                   ("scouting/multicast/enabled", "false")):
    config.insert_json5(key, value)
with zenoh.open(config):
    print("ready", flush=True)
    threading.Event().wait()
"""


class CannotBeHadError(Exception):
    """This machine does not allow that fault; the message names what is missing."""


def stopped(role: str, seconds: float) -> Act:
    def act(drive: Drive) -> None:
        process = drive.process(role)
        os.kill(process, signal.SIGSTOP)
        time.sleep(seconds)
        with suppress(ProcessLookupError):
            os.kill(process, signal.SIGCONT)

    return act


def killed(role: str, times: int, every_s: float = 2.0) -> Act:
    def act(drive: Drive) -> None:
        for k in range(times):
            time.sleep(every_s if k else 0.0)
            os.kill(drive.process(role), signal.SIGKILL)

    return act


def service_killed(times: int, longest_s: float) -> Act:
    """At random moments after READY; it is started again each time."""

    def act(drive: Drive) -> None:
        for up_s in np.random.default_rng(times).uniform(0.0, longest_s, times):
            time.sleep(up_s)
            drive.end(signal.SIGKILL)
            drive.start()

    return act


def other_program(seconds: float) -> Act:
    """It opens the ports of the devices, too, and reads."""

    def act(drive: Drive) -> None:
        with ExitStack() as stack:
            for endpoint in drive.endpoints.values():
                host, _, port = endpoint.rpartition(":")
                if host:
                    stack.enter_context(socket.create_connection((host, int(port)), timeout=1.0))
                else:
                    file = os.open(endpoint, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
                    stack.callback(os.close, file)
                    with suppress(BlockingIOError):
                        os.read(file, 65_536)
            time.sleep(seconds)

    return act


@contextmanager
def disk(folder: Path) -> Iterator[dict[str, Any]]:
    """A file system of its own for the recordings, which goes read-only where it meets an error."""
    image, sessions = folder / "disk.img", folder / "sessions"
    sessions.mkdir()
    with image.open("wb") as file:
        file.truncate(DISK_MB << 20)
    _root("mkfs.ext4", "-q", image)
    _root("mount", "-o", "loop,errors=remount-ro", image, sessions)
    try:
        yield {}
    finally:
        _root("umount", sessions)


def frozen_disk(seconds: float) -> Act:
    def act(drive: Drive) -> None:
        _root("fsfreeze", "--freeze", drive.service.sessions)
        try:
            time.sleep(seconds)
        finally:
            _root("fsfreeze", "--unfreeze", drive.service.sessions)

    return act


def full_disk(seconds: float) -> Act:
    def act(drive: Drive) -> None:
        filler = drive.service.sessions / "filler"
        with filler.open("wb") as file, suppress(OSError):
            while file.write(b"\0" * 1_000_000):
                file.flush()
        time.sleep(seconds)
        filler.unlink()

    return act


def read_only_disk(drive: Drive) -> None:
    """As ext4 does after an error. It stays so; poses go on."""
    device = Path(_root("findmnt", "--noheadings", "--output", "SOURCE", drive.service.sessions).strip()).name
    (Path("/sys/fs/ext4") / device / "trigger_fs_error").write_text("chaos")
    wait_for_poses(drive.service.endpoint, 10.0)


@contextmanager
def memory_group(folder: Path) -> Iterator[dict[str, Any]]:
    group = MEMORY / f"corridor-{folder.name}"
    try:
        group.mkdir()
    except OSError as error:
        raise CannotBeHadError(f"no control group of memory: {error}") from error
    try:
        yield {"group": group}
    finally:
        group.rmdir()


def less_memory(share: float, seconds: float) -> Act:
    """A limit below what the service has in use, then none again."""

    def act(drive: Drive) -> None:
        group: Path = drive.settings["group"]
        for process in drive.processes():
            (group / "cgroup.procs").write_text(str(process))
        resident = 1e6 * sum(map(resident_mb, drive.processes()))
        limit = group / "memory.limit_in_bytes"
        with suppress(OSError):  # busy: it could not free as much at once
            limit.write_text(str(round(share * resident)))
        time.sleep(seconds)
        limit.write_text("-1")

    return act


@contextmanager
def wall_clock(folder: Path, begins_s: int = 0) -> Iterator[dict[str, Any]]:
    """Of the service alone; off by begins_s when it starts.

    Not by libfaketime 0.9.10: with it every time.sleep of Python 3.11 fails once the clock is off.
    """
    library, offset = folder / "wall_clock.so", folder / WALL_CLOCK
    _root("cc", "-shared", "-fPIC", "-O2", "-o", library, Path(__file__).with_name("wall_clock.c"))
    offset.write_bytes(struct.pack("q", begins_s))
    yield {"environment": {"LD_PRELOAD": str(library), "WALL_CLOCK": str(offset)}}


def set_wall_clock(folder: Path, off_s: int) -> None:
    """Of processes that run: off by so much from now on."""
    with (folder / WALL_CLOCK).open("r+b", buffering=0) as file:  # mapped: not to be cut off
        file.write(struct.pack("q", off_s))


def clock_step(to_s: int) -> Act:
    return lambda drive: set_wall_clock(drive.folder, to_s)


@contextmanager
def router(folder: Path) -> Iterator[dict[str, Any]]:
    """A router of the site, to which the service connects."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    routers = [_router(endpoint)]
    try:
        yield {"publishing": {"connect": [endpoint]}, "routers": routers, "endpoint": endpoint}
    finally:
        for process in routers:
            process.kill()
            process.communicate()


def _router(endpoint: str) -> subprocess.Popen[bytes]:
    process = subprocess.Popen([sys.executable, "-c", ROUTER, endpoint], stdout=subprocess.PIPE)
    process.stdout.readline()
    return process


def router_gone(seconds: float) -> Act:
    """Poses come again through it, too, once it is back."""

    def act(drive: Drive) -> None:
        endpoint, routers = drive.settings["endpoint"], drive.settings["routers"]
        wait_for_poses(endpoint, 10.0)
        routers[-1].kill()
        time.sleep(seconds)
        routers.append(_router(endpoint))
        began_s = time.monotonic()
        wait_for_poses(endpoint, 10.0)
        drive.notes.append(f"poses behind the router again after {time.monotonic() - began_s:.1f} s")

    return act


def wait_for_poses(endpoint: str, timeout_s: float = PATIENCE_S) -> None:
    with closing(Subscriber(endpoint)) as subscriber:
        subscriber.wait_for("pose", 20, timeout_s)


def _root(*command: str | Path) -> str:
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=60).stdout
    except FileNotFoundError as error:
        raise CannotBeHadError(f"no {command[0]}") from error
    except subprocess.CalledProcessError as error:
        raise CannotBeHadError(f"{command[0]}: {error.stderr.strip()}") from error
