"""Five fake devices and `corridor run`, each in processes of its own, with a fault."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple
from unittest.mock import patch

import yaml

from service.demo import DemoOptions, demo_config, simulators
from tests.processes import Process, alive, command_of
from tests.system.machine import LiveService, free_port
from tests.waiting import wait_until

CORRIDOR = Path(sys.executable).parent / "corridor"
RESUMED = "it goes on in"  # of the service's log, see service.runtime.resume
ROLES = ("service", "mapper", "stand-by", "back end")


class Interval(NamedTuple):
    """Of the host's monotonic clock."""

    from_ns: int
    until_ns: int


class Up(NamedTuple):
    """A run of the service, from READY to its end."""

    from_ns: int
    until_ns: int
    is_resumed: bool  # it went on in the map of the run before
    code: int


class Drive:
    """A run of the service, or several, while the vehicle drives.

    cause        interval of the fault
    endpoints    of the devices, by name: host:port or a path
    settings     of `Live.place`; "environment" is that of the service, besides the usual one
    notes        further figures, for the table
    left_out     messages that the fake devices left out for want of processor time; known at the end
    """

    def __init__(
        self,
        folder: Path,
        service: LiveService,
        ride_ns: int,
        endpoints: dict[str, str],
        settings: dict[str, Any],
    ) -> None:
        self.folder, self.service, self.ride_ns = folder, service, ride_ns
        self.endpoints, self.settings = endpoints, settings
        self.cause = Interval(ride_ns, ride_ns)
        self.ups: list[Up] = []
        self.notes: list[str] = []
        self.left_out = 0
        self._log_length = self._ready_ns = 0
        self._mappers: set[int] = set()  # sessions of processes

    def start(self) -> None:
        with patch.dict(os.environ, self.settings.get("environment", {})):
            self.service.start(watchdog_s=30.0)
        self._ready_ns = time.monotonic_ns()

    def end(self, number: signal.Signals = signal.SIGTERM) -> None:
        self.service.signal(number)
        ended_ns, code, log = time.monotonic_ns(), self.service.wait(), self.service.log
        self.ups.append(Up(self._ready_ns, ended_ns, RESUMED in log[self._log_length :], code))
        self._log_length = len(log)

    def configure(self, **sections: dict[str, object]) -> None:
        """Before a start: further settings of the config's sections."""
        config = yaml.safe_load(self.service.config.read_text())
        for section, settings in sections.items():
            config.setdefault(section, {}).update(settings)
        self.service.config.write_text(yaml.safe_dump(config))

    def run_until(self, at_s: float) -> None:
        """Until at_s after the ride began; returns at once where that is past."""
        time.sleep(max(0.0, self.ride_ns / 1e9 + at_s - time.monotonic()))

    @contextmanager
    def caused(self) -> Iterator[None]:
        """The fault is active inside the block."""
        began_ns = time.monotonic_ns()
        try:
            yield
        finally:
            self.cause = Interval(began_ns, time.monotonic_ns())

    def process(self, role: str) -> int:
        """Process id; waits for a stand-by, which is forked each few seconds."""
        if role == "service":
            return self.service.pid
        found: list[int] = []
        wait_until(lambda: found.extend(self._processes(role)) or found, words=f"there is no {role}")
        return found[0]

    def processes(self) -> list[int]:
        """All of the service."""
        return [self.service.pid, *(stat.pid for stat in self._of_the_mapper())]

    def _processes(self, role: str) -> list[int]:
        """Back ends have a higher nice value than mappers; a mapper is older than its stand-by."""
        ours = self._of_the_mapper()
        lowest = min((stat.niceness for stat in ours), default=0)
        mappers = [stat.pid for stat in ours if stat.niceness == lowest]
        back_ends = [stat.pid for stat in ours if stat.niceness > lowest]  # the stand-by's is younger
        return {"mapper": mappers[:1], "stand-by": mappers[:0:-1], "back end": back_ends[:1]}[role]

    def _of_the_mapper(self) -> list[Process]:
        """Oldest first."""
        stats = [one for one in alive() if "service.runtime.mapper_process" in command_of(one.pid)]
        self._mappers |= {stat.session for stat in stats if stat.parent == self.service.pid}
        return sorted((stat for stat in stats if stat.session in self._mappers), key=lambda stat: stat.begun)


@contextmanager
def driving(folder: Path, settings: dict[str, Any], seed: int) -> Iterator[Drive]:
    """The devices are on their wires; the service does not run yet."""
    options = DemoOptions(None, None, None, seed, folder, None)
    truth = folder / "truth.txt"
    with simulators(options, truth) as fakes:
        sensors = yaml.safe_load(demo_config(fakes.endpoints, options, free_port()).text)["sensors"]
        for name in ("rear", "lux"):  # harder with one laser, and a busy machine keeps up
            sensors[name]["map"] = False
        service = LiveService(folder, sensors, **settings.get("publishing", {}))
        wait_until(lambda: truth.read_text().count("\n") > 1, words="the simulators write no truth")
        try:
            endpoints = {one["name"]: one["endpoint"].removeprefix("tcp://") for one in fakes.endpoints}
            ride_ns = int(truth.read_text().partition(" ")[0])
            drive = Drive(folder, service, ride_ns, endpoints, settings)
            yield drive
        finally:
            service.close()
    drive.left_out = sum(fakes.left_out.values())


def corridor(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run([CORRIDOR, *arguments], capture_output=True, text=True, timeout=300, check=False)
