"""Ctrl-C and SIGTERM at any moment of a command whose kernels have to be compiled first."""

import os
import random
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import pytest
import yaml

from tests.groups import children_cpu_s
from tests.processes import alive, look_at
from tests.shared_data import NO_RECORDINGS, SHARED
from tests.soaked import in_soak
from tests.waiting import wait_until

MAX_CPU_S = 2.0  # two processes may each end an import of 0.75 s; a kernel compiled to its end takes up to 3
SPAN_S = 5.0  # imports, the first compiled kernels, the start of the process that helps
PATIENCE_S = 60.0
CODES = {
    ("run", "SIGTERM"): 0,
    ("demo", "SIGTERM"): 0,
    ("replay", "SIGTERM"): 143,
    ("warmup", "SIGTERM"): 143,
    **{(command, "SIGINT"): 130 for command in ("run", "demo", "replay", "warmup")},
}
SPANS_S = {"at once": (0.0, 0.0), "soon": (0.0, 2.0), "late": (2.0, SPAN_S)}
# Each command, two by each signal, and each kind of moment.
NOW = {("run", "SIGTERM", "late"), ("demo", "SIGINT", "soon"), ("replay", "SIGTERM", "soon"),
       ("warmup", "SIGINT", "at once")}  # fmt: skip
MOMENTS = [(*of, when) if (*of, when) in NOW else in_soak(*of, when) for of in CODES for when in SPANS_S]


@pytest.fixture
def begin(tmp_path: Path) -> Iterator[Callable[[str], subprocess.Popen[bytes]]]:
    """Begins a command with an empty kernel cache, in a group of its own, as a shell does."""
    config = tmp_path / "vehicle.yaml"
    settings = {
        "vehicle": "v",
        "sensors": {"front": {"type": "sick_lms100", "host": "127.0.0.1", "port": 9}},
        "publishing": {"listen": ["tcp/127.0.0.1:0"]},
        "recording": {"directory": str(tmp_path / "sessions"), "keep_free_gb": 0.0},
        "map": {"directory": str(tmp_path / "maps")},
    }
    config.write_text(yaml.safe_dump(settings))
    recording = SHARED / "worlds" / "tshape_s2" / "tshape_s2.mcap"
    arguments = {
        "run": [config],
        "demo": ["--out", tmp_path / "demo"],
        "replay": [recording, "--out", tmp_path / "replay"],
        "warmup": [],
    }
    begun: list[subprocess.Popen[bytes]] = []

    def begin_one(command: str) -> subprocess.Popen[bytes]:
        if command == "replay" and not recording.exists():
            pytest.skip(NO_RECORDINGS)
        process = subprocess.Popen(
            [sys.executable, "-m", "service", command, *map(str, arguments[command])],
            env=os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "cache")},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
        begun.append(process)
        return process

    yield begin_one
    for process in begun:
        for pid in alive_in(process.pid):
            os.kill(pid, signal.SIGKILL)
        process.wait()
        process.stdout.close()


@pytest.mark.timeout(300)
@pytest.mark.parametrize(("command", "name", "when"), MOMENTS)
def test_a_signal_at_any_moment_ends_a_command_at_once(
    command: str, name: str, when: str, begin: Callable[[str], subprocess.Popen[bytes]]
):
    at_s = random.Random(f"{command} {name}").uniform(*SPANS_S[when])  # always the same
    process = begin(command)
    wait_until_it_takes_signals(process.pid)
    with pytest.raises(subprocess.TimeoutExpired):
        process.wait(at_s)
    family = descendants(process.pid)  # the mapper is in a session of its own
    before_s = children_cpu_s() + sum(family.values())
    if name == "SIGINT":
        os.killpg(process.pid, signal.SIGINT)  # a terminal tells the whole group
    else:
        process.send_signal(signal.SIGTERM)
    printed, _ = process.communicate(timeout=PATIENCE_S)
    more_s = children_cpu_s() - before_s  # of its own; no one waits for the processes that it killed
    where = f"{command}, {name} after {at_s:.2f} s printed {printed.decode()}"
    assert process.returncode == CODES[command, name], where
    assert more_s < MAX_CPU_S, where
    assert b"Traceback" not in printed, where
    assert b"Exception ignored" not in printed, where
    wait_until(lambda: not alive_in(process.pid), PATIENCE_S, f"they have not ended; {where}")
    wait_until(lambda: not any(map(look_at, family)), PATIENCE_S, f"the children have not ended; {where}")


@pytest.mark.parametrize("command", ["calibrate", "map"])
def test_ctrl_c_unwinds_nothing_that_may_be_in_a_kernel(command: str):
    work = (
        "import signal, sys, service.cli\n"
        "service.cli.main = lambda: signal.raise_signal(signal.SIGINT)\n"
        "from service.command import main\n"
        f"sys.argv = ['corridor', '-v', {command!r}, 'x']\n"
        "main()\n"
    )
    ended = subprocess.run([sys.executable, "-c", work], capture_output=True, timeout=PATIENCE_S, check=False)
    assert (ended.returncode, ended.stderr) == (130, b"")


@pytest.mark.soak
@pytest.mark.timeout(300)
def test_what_an_interrupted_warm_up_has_compiled_is_used_by_the_next(
    tmp_path: Path, begin: Callable[[str], subprocess.Popen[bytes]]
):
    process = begin("warmup")
    kernels = partial((tmp_path / "cache").rglob, "*.nbc")
    wait_until(lambda: any(kernels()), PATIENCE_S, "no kernel came")
    os.killpg(process.pid, signal.SIGINT)
    assert process.wait(PATIENCE_S) == 130
    kept = {path: path.stat().st_mtime_ns for path in kernels()}
    begin("warmup")
    wait_until(lambda: len(list(kernels())) > len(kept), PATIENCE_S, "no kernel came beyond those")
    assert {path: path.stat().st_mtime_ns for path in kept} == kept


def wait_until_it_takes_signals(pid: int) -> None:
    def takes() -> bool:
        status = Path(f"/proc/{pid}/status").read_text()
        caught = int(next(line for line in status.splitlines() if line.startswith("SigCgt")).split()[1], 16)
        return bool(caught >> (signal.SIGTERM - 1) & 1)

    wait_until(takes, PATIENCE_S, "there is no handler of signals")


def alive_in(group: int) -> list[int]:
    """Processes of a group that have not ended."""
    return [one.pid for one in alive() if one.group == group]


def descendants(pid: int) -> dict[int, float]:
    """Processor time of a process, its children, their children and so on, as far as they have not ended."""
    there, family = {one.pid: one for one in alive()}, {pid}
    while more := {one.pid for one in there.values() if one.parent in family} - family:
        family |= more
    return {one: there[one].cpu_s for one in family & there.keys()}
