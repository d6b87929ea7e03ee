"""`make test`: groups of tests side by side, how far each is while it runs, and their failures at the end.

Priorities (nice) rise from groups that compute, over those with browsers and clocks, to those in real time.
"""

import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from service.compile.cache import ensure_cache_dir, is_warm

LOGS = Path("build")
REPORT_S = 10.0  # between two lines of progress
LOOK_S = 0.5
MAX_SILENCE_S = 900.0  # of a group; no test may take as long
# Set, each of some hundred processes would compile every file again: a third of their processor time.
WITHOUT_BYTECODE = "PYTHONDONTWRITEBYTECODE"
EXPECTED = "some five minutes on two cores, ten on slow ones"
MACHINES = ("tests/docs", "tests/system")  # services with all their devices, in real time
DOCTOR = "tests/service/offline/doctor"
REMAP = "tests/service/offline/maps/test_remap.py"
BROWSER = ("tests/browser",)
PAGES = (  # against clocks, and mostly waiting, as those of the browser
    DOCTOR,
    *(f"tests/service/{folder}" for folder in ("fleet", "publishing", "ros2_sensors", "sinks", "web")),
)
PARTS = (  # each on its own: drivers, fake devices, kernels
    *("tests/chaos", "tests/drivers", "tests/fuzz", "tests/simulators"),
    *(f"tests/service/{folder}" for folder in ("estimator", "geometry", "kernels")),
)
MAPPING = (
    *("tests/accuracy", "tests/service/mapper"),
    REMAP,  # which begins with a map of the others'
)
OFFLINE = ("tests/service/offline", *(f"--ignore={path}" for path in (DOCTOR, REMAP)))  # of other groups
_SHARE = re.compile(r"\[ *(\d+)%\]")
_FAILED = re.compile(r"^FAILED .+::.+$", re.MULTILINE)  # see tests/failures_at_once.py
_SKIP = re.compile(r"^SKIPPED \[(\d+)\] (.*)$", re.MULTILINE)


@dataclass(frozen=True)
class Group:
    name: str
    arguments: tuple[str, ...]
    niceness: int

    @property
    def paths(self) -> tuple[str, ...]:
        """Those of the arguments that are not options."""
        return tuple(one for one in self.arguments if not one.startswith("-"))


NAMED = (
    Group("machines", MACHINES, niceness=0),
    Group("browser", BROWSER, niceness=5),
    Group("pages", PAGES, niceness=5),
    Group("parts", PARTS, niceness=9),
    Group("mapping", MAPPING, niceness=8),
    Group("offline", OFFLINE, niceness=10),
)
REST = tuple(f"--ignore={path}" for group in NAMED for path in group.paths)
GROUPS = (*NAMED, Group("service", REST, niceness=10))


class Running:
    """One group in a process of its own; its output goes to a file, what its tests write below `scratch`."""

    def __init__(self, group: Group, folder: Path, scratch: Path) -> None:
        self.group = group
        self.log = folder / f"{group.name}.log"
        self._began_s = time.monotonic()
        self._file: IO[str] = self.log.open("w")
        # faulthandler: SIGABRT writes the stacks of all threads to the log
        command = [sys.executable, "-X", "faulthandler", "-m", "pytest"]
        command += ["-q", "-rs", "-p", "tests.failures_at_once", "-m", "not soak and not bench"]
        command += ["--durations=25"]  # its slowest tests are at the end of its output
        # By default all groups share one folder; two that clear it at the same time at their ends fail.
        command += [f"--basetemp={scratch / group.name}"]
        self.process = subprocess.Popen(
            ["nice", "-n", str(group.niceness), *command, "-p", "no:cacheprovider", *group.arguments],
            env={name: value for name, value in os.environ.items() if name != WITHOUT_BYTECODE},
            stdout=self._file,
            stderr=subprocess.STDOUT,
        )
        self.reported = False
        self._cpu_s = 0.0
        self._log_bytes = 0
        self._wrote_s = self._began_s
        self._failures = 0  # reported so far

    def wait(self, seconds: float) -> bool:
        """Whether it has ended within so long; the processor time of an ended one is read here."""
        if self.process.returncode is None:
            before_s = children_cpu_s()
            with suppress(subprocess.TimeoutExpired):
                self.process.wait(seconds)
                self._cpu_s = children_cpu_s() - before_s
        return self.process.returncode is not None

    def abort_if_silent(self) -> None:
        """End it, with the stacks of its threads in its log, where it wrote nothing for MAX_SILENCE_S."""
        now_s, log_bytes = time.monotonic(), self.log.stat().st_size
        if log_bytes != self._log_bytes:
            self._wrote_s, self._log_bytes = now_s, log_bytes
        elif now_s - self._wrote_s > MAX_SILENCE_S:
            self.process.send_signal(signal.SIGABRT)

    @property
    def text(self) -> str:
        return self.log.read_text(errors="replace")

    @property
    def percent(self) -> int:
        shares = _SHARE.findall(self.text)
        return int(shares[-1]) if shares else 0

    def new_failures(self) -> list[str]:
        """A line for each test that has failed since the last call."""
        lines = _FAILED.findall(self.text)
        new, self._failures = lines[self._failures :], len(lines)
        return new

    def end(self) -> str:
        """Its last line of output, once it has ended."""
        self._file.close()
        words = self.text.strip().splitlines() or ["no output"]
        took_s = time.monotonic() - self._began_s
        return (
            f"{self.group.name}: exit code {self.process.returncode} after {took_s:.0f} s, "
            f"{self._cpu_s:.0f} s of processor: {words[-1]}"
        )


def run(groups: Sequence[Group], folder: Path = LOGS) -> int:
    """Run them; 0 where all passed, 1 where one did not: then the files of the tests are left."""
    folder.mkdir(exist_ok=True)
    scratch = Path(tempfile.mkdtemp(prefix="tests-"))
    say(f"{len(groups)} groups of tests side by side, {EXPECTED}; their words: {folder}/<group>.log")
    began_s = reported_s = time.monotonic()
    running = [Running(group, folder, scratch) for group in groups]
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(128 + number))
    try:
        while alive := [one for one in running if not one.wait(0.0)]:
            alive[0].wait(LOOK_S)
            for one in running:
                one.abort_if_silent()
                if one.wait(0.0) and not one.reported:
                    one.reported = True
                    say(one.end())
            if time.monotonic() - reported_s >= REPORT_S:
                reported_s = time.monotonic()
                for line in (line for one in running for line in one.new_failures()):
                    say(line)
                shares = ", ".join(f"{o.group.name} {o.percent} %" for o in running if not o.reported)
                if shares:
                    say(f"{reported_s - began_s:4.0f} s: {shares}")
    finally:
        for one in running:
            if one.process.poll() is None:
                one.process.terminate()
                one.process.wait()
    exit_code = summarise(running, time.monotonic() - began_s)
    if exit_code == 0:
        shutil.rmtree(scratch, ignore_errors=True)
    else:
        say(f"what the tests wrote: {scratch}")
    return exit_code


def summarise(running: Sequence[Running], took_s: float) -> int:
    """Failures whole, each reason to skip once with its count, and what it cost."""
    failed = [one for one in running if one.process.returncode != 0]
    for one in running:
        if not one.reported:
            say(one.end())
    for one in failed:
        say(f"\n===== {one.group.name} =====")
        say(one.text)
    skips: Counter[str] = Counter()
    for one in running:
        for count, reason in _SKIP.findall(one.text):
            skips[reason.partition(": ")[2] or reason] += int(count)
    for reason, count in sorted(skips.items()):
        say(f"skipped {count}: {reason}")
    say(f"{took_s:.0f} s, {children_cpu_s():.0f} s of processor")
    say(f"FAILED: {', '.join(one.group.name for one in failed)}" if failed else "all passed")
    return 1 if failed else 0


def children_cpu_s() -> float:
    """Of all children of this process that have ended and were waited for, and of theirs."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def say(words: str) -> None:
    print(words, flush=True)


if __name__ == "__main__":
    os.chdir(Path(__file__).parents[1])
    ensure_cache_dir()
    if not is_warm():  # once, on all cores, before each group would
        subprocess.run([sys.executable, "-m", "service", "warmup"], check=True)
    sys.exit(run(GROUPS))
