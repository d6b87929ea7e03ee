import os
import pickle
import subprocess
import sys
from pathlib import Path

import pytest
from numba import njit

from service.compile import warm_up as module
from service.compile.cache import cache_folder
from service.compile.signatures import Job
from service.compile.warm_up import KernelProgress, warm_up
from service.compile.worker import Worker

CORES = {0, 1}


class Work:
    """Jobs in place of the kernels of this process; "cached" ones compile nothing."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.done: list[str] = []
        monkeypatch.setattr(Job, "do", lambda job: self._do(job))
        monkeypatch.setattr(Job, "reached", lambda job: frozenset())
        self._monkeypatch = monkeypatch

    def is_to_do(self, every: str, seldom: str = "") -> None:
        jobs = (
            [Job("made_up", name, 0, 10) for name in every.split()],
            [Job("made_up", name, 0, 10) for name in seldom.split()],
        )
        self._monkeypatch.setattr(module, "jobs_of_process", lambda back_end_elsewhere: jobs)

    def _do(self, job: Job) -> None:
        if not job.name.startswith("cached") and job.name not in self.done:
            njit(lambda x: x + 1)(1)
        self.done.append(job.name)


def worker_that(does: str) -> type[Worker]:
    """A process that does something else instead of compiling."""

    class Pretended(subprocess.Popen[bytes]):
        def __init__(self) -> None:
            pipe = subprocess.PIPE
            command = [sys.executable, "-c", f"import sys\nprint(flush=True)\n{does}"]
            super().__init__(command, bufsize=0, stdin=pipe, stdout=pipe)

        send, wait_for_line = Worker.send, Worker.wait_for_line

    return Pretended  # type: ignore[return-value]


OBEYS = "for line in sys.stdin:\n    if line == 'null\\n': break\n    print(flush=True)"
DIES = "sys.stdin.readline()\nsys.exit(3)"


@pytest.fixture
def work(monkeypatch: pytest.MonkeyPatch) -> Work:
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: CORES)
    monkeypatch.setattr(module, "Worker", worker_that(OBEYS))
    return Work(monkeypatch)


@pytest.mark.parametrize(("does", "warnings"), [(OBEYS, 0), (DIES, len(CORES))])
def test_what_other_processes_compiled_is_loaded_here_or_compiled_if_they_died(
    does: str, warnings: int, work: Work, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    names = {f"job{k}" for k in range(8)}
    work.is_to_do(" ".join(names))
    monkeypatch.setattr(module, "Worker", worker_that(does))
    progress = KernelProgress(lambda p: None)
    warm_up(progress=progress)
    assert sorted(work.done) == sorted(names)  # each once in this process
    assert caplog.text.count("ended with code 3; what is left is compiled here") == warnings
    assert progress.share == 1.0


def test_no_process_begins_where_all_is_in_the_cache(work: Work, monkeypatch: pytest.MonkeyPatch):
    work.is_to_do("cached1 cached2", "cached3")
    monkeypatch.setattr(module, "Worker", lambda: pytest.fail("a process was begun"))
    changes: list[float] = []
    assert warm_up(progress=KernelProgress(lambda p: changes.append(p.share))) == []
    assert work.done == ["cached1", "cached2", "cached3"]
    assert changes == []


def test_progress_is_that_of_what_is_not_in_the_cache(work: Work):
    work.is_to_do("cached a b", "c d")
    reported: list[tuple[float, str]] = []
    progress = KernelProgress(lambda p: reported.append((p.share, str(p).rpartition(",")[0])))
    assert str(progress) == "loading kernels, 0 s"
    warm_up(progress=progress)
    assert reported == [(k / 4, f"compiling kernels: {k} of 4") for k in range(1, 5)]


def test_seldom_kernels_that_are_not_in_the_cache_are_left_out_on_request(work: Work):
    work.is_to_do("a", "cached b c")
    left = warm_up(leaves_seldom=True)
    assert [job.name for job in left] == ["b", "c"]
    assert work.done == ["cached", "a"]
    assert warm_up() == []
    assert work.done[-2:] == ["b", "c"]


def test_a_cache_that_was_cut_short_is_emptied_and_filled_again(
    work: Work, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, caplog: pytest.LogCaptureFixture
):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    damaged = cache_folder() / "match.match_scan-1.py311.nbi"
    damaged.parent.mkdir()
    damaged.write_bytes(b"")
    work.is_to_do("cached")
    do = Job.do

    def load(job: Job) -> None:
        if damaged.exists():
            pickle.loads(damaged.read_bytes())
        do(job)

    monkeypatch.setattr(Job, "do", load)
    warm_up()
    assert work.done == ["cached"]
    assert not damaged.exists()
    assert "all are compiled again" in caplog.text
