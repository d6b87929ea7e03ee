"""64 short sessions on each engine: same bytes, speed-up, killed workers."""

import hashlib
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, cast

from service.offline.cluster.batch import run_batch
from service.offline.cluster.engines import Cluster, Engine, Processes, in_turn
from service.offline.cluster.session_task import new_tasks
from service.offline.past.result import DONE_FILE
from service.offline.replay.replay import ReplayOptions
from simulators.worlds import WORLDS
from tests.processes import alive, command_of
from tests.recorded_drive import record
from tests.s3_bucket import s3_bucket
from tests.service.recording.sessions import T0_NS
from tests.simulated import FORWARD, LMS100_50HZ, Wheels, drives

SESSIONS, SECONDS = 64, 15.0
Row = tuple[str, float, str]
Disturb = Callable[[int], None]  # called with the number of sessions that have ended


class _Run:
    """The sessions in a folder, by one engine after the other."""

    def __init__(self, sessions: Sequence[Path], folder: Path) -> None:
        self._sessions, self._folder = sessions, folder
        self._expected = ""

    def __call__(
        self, name: str, engine: Engine, disturb: Disturb = lambda ended: None, bucket: Path | None = None
    ) -> float:
        """Seconds. Raises AssertionError where a result differs from that of the first engine.

        bucket   has the sessions in `in`, and gets the results; None: all is on the disk
        """
        sessions = [path if bucket is None else bucket / "in" / path.name for path in self._sessions]
        out = (bucket or self._folder) / name
        tasks = new_tasks(
            [[path] for path in sessions], ReplayOptions(), [out / path.stem for path in sessions]
        )
        began_s = time.monotonic()
        done = run_batch(tasks, engine, lambda share, *_: disturb(round(share * len(tasks))))
        taken_s = time.monotonic() - began_s
        faults = [one.outcome for one in done if not isinstance(one.outcome, dict)]
        assert not faults, faults
        if bucket is not None:
            cast(Any, bucket).fs.get(cast(Any, out).path, str(self._folder / name), recursive=True)
        digest = digest_of(self._folder / name, without=("summary.json", DONE_FILE))
        self._expected = self._expected or digest
        assert digest == self._expected, f"{name}: other bytes"
        return taken_s


def digest_of(folder: Path, without: Sequence[str] = ()) -> str:
    """Of all files below it, but for those of some names."""
    digest = hashlib.sha256()
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        if path.name not in without:
            digest.update(f"{path.relative_to(folder)}".encode() + path.read_bytes())
    return digest.hexdigest()


def measure() -> list[Row]:
    with TemporaryDirectory(prefix="corridor-bench-") as folder, ExitStack() as stack:
        sessions = _record(Path(folder))
        run = _Run(sessions, Path(folder))
        run("warm", in_turn)  # kernels and files are in memory from here on
        serial_s = run("serial", in_turn)
        with Processes(2) as processes:
            jobs_s = run("jobs", processes)
        with Cluster("local:2") as cluster:
            dask_s = run("dask", cluster)
            empty_s = run("dask", cluster)  # all is done: the rest is the cost of the task itself
        bucket = stack.enter_context(s3_bucket())
        for session in sessions:
            (bucket / "in" / session.name).write_bytes(session.read_bytes())
        with Processes(2) as processes:
            stored_s = run("stored", processes, bucket=bucket)
        address, scheduler = stack.enter_context(_dask(Path(folder)))
        with Cluster(address) as cluster:
            killed_s = run("killed", cluster, _once(lambda: os.kill(_a_worker(), signal.SIGKILL)))
        with Cluster(address) as cluster:
            restarted_s = run("restarted", cluster, _once(scheduler.restart))
    return [
        (f"{SESSIONS} sessions, serial", serial_s, "s"),
        ("--jobs 2", jobs_s, "s"),
        ("--jobs 2, speed-up", serial_s / jobs_s, "x"),
        ("--cluster local:2", dask_s, "s"),
        ("--cluster local:2, speed-up", serial_s / dask_s, "x"),
        ("task that is done already", 1e3 * empty_s / SESSIONS, "ms"),
        ("--jobs 2, from S3 and to it", stored_s, "s"),
        ("2 workers, one killed", killed_s, "s"),
        ("2 workers, scheduler restarted", restarted_s, "s"),
    ]


def _record(folder: Path) -> list[Path]:
    laser = replace(LMS100_50HZ, rate_hz=25.0)
    made = []
    for k, drive in enumerate(drives(WORLDS["office"](), laser, SECONDS, range(1, SESSIONS + 1), Wheels())):
        session = record(drive.frames, {"front": FORWARD}, folder / "in" / str(k), T0_NS)
        made.append(session.rename(folder / f"drive{k:02}.mcap"))
    return made


def _once(act: Callable[[], object]) -> Disturb:
    """After a third of the sessions."""
    waiting = [act]

    def disturb(ended: int) -> None:
        if ended >= SESSIONS // 3 and waiting:
            waiting.pop()()

    return disturb


class _Scheduler:
    """A Dask scheduler as a program, always at one port."""

    def __init__(self, port: int) -> None:
        self._command = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1"]
        self._command += ["--port", str(port), "--no-dashboard"]
        self._process = self._start()

    def _start(self) -> "subprocess.Popen[bytes]":
        return subprocess.Popen(self._command, stderr=subprocess.DEVNULL)

    def restart(self) -> None:
        self.end()
        self._process = self._start()

    def end(self) -> None:
        self._process.kill()
        self._process.wait()


@contextmanager
def _dask(folder: Path) -> Iterator[tuple[str, _Scheduler]]:
    """A scheduler and two workers, which start again when they end, as a service manager has them do."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    address = f"tcp://127.0.0.1:{port}"
    scheduler = _Scheduler(port)
    worker = f"{sys.executable} -m distributed.cli.dask_worker {address} --nthreads 1 --no-dashboard"
    loop = f"while :; do {worker} --local-directory {folder}/dask 2>/dev/null; sleep 0.2; done"
    workers = [subprocess.Popen(["sh", "-c", loop], start_new_session=True) for _ in range(2)]
    try:
        yield address, scheduler
    finally:
        for one in workers:
            os.killpg(one.pid, signal.SIGKILL)
            one.wait()
        scheduler.end()


def _a_worker() -> int:
    """Process id of a worker below one of the nannies: the child that multiprocessing spawned."""
    return next(
        one.pid
        for one in alive()
        if "spawn_main" in command_of(one.pid) and "dask_worker" in command_of(one.parent)
    )
