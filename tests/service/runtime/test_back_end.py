import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import pytest

from service.mapper.background import BackEndDiedError, WorkLostError
from service.runtime import back_end
from service.runtime.back_end import BackEndProcess, ProcessJob, ProcessWorker
from tests.processes import is_there, look_at
from tests.waiting import wait_until


class Adder:
    """Sums what it gets; sent a word, it misbehaves; a pipe counts for 10 once someone has written to it."""

    def __init__(self) -> None:
        self.total = 0
        self.known_ground = b""

    def work(self, batch: object) -> tuple[int, int]:
        if batch == "raise":
            raise ValueError("cannot add that")
        if batch == "hang":
            signal.pause()
        if batch == "compute":
            end_s = time.monotonic() + 60.0
            while time.monotonic() < end_s:
                self.total += 1
        if isinstance(batch, bytes):
            batch = 1
        if isinstance(batch, Path):
            batch.read_bytes()
            batch = 10
        assert isinstance(batch, int)
        self.total += batch
        return self.total, os.getpid()


@pytest.fixture
def process() -> Iterator[BackEndProcess]:
    process = BackEndProcess(patience_s=30.0)
    yield process
    process.stop()


def test_work_is_done_in_order_by_one_state_in_another_process(process: BackEndProcess):
    worker = process.new_worker(Adder())
    pending = [worker.submit(k) for k in (1, 10, 100)]
    results = [p.result() for p in pending]
    assert [total for total, _ in results] == [1, 11, 111]
    assert {pid for _, pid in results} == {process.pid}
    assert process.pid != os.getpid()
    assert all(p.ready for p in pending)


def test_how_far_it_is_behind_is_the_age_of_the_oldest_work_without_an_answer(
    process: BackEndProcess, gate: Path, monkeypatch: pytest.MonkeyPatch
):
    now_s = 100.0
    monkeypatch.setattr(back_end, "time", SimpleNamespace(monotonic=lambda: now_s))
    worker = process.new_worker(Adder())
    assert process.behind_s == 0.0
    first, second = worker.submit(gate), worker.submit(1)
    now_s = 107.0
    third = worker.submit(2)
    assert process.behind_s == 7.0
    gate.write_bytes(b"go on")
    wait_until(lambda: second.ready and third.ready, words="the work is not done")
    assert first.ready
    assert process.behind_s == 0.0
    last = worker.submit(gate)
    now_s = 109.0
    assert process.behind_s == 2.0
    gate.write_bytes(b"go on")  # a process that hangs would outlive the test
    wait_until(lambda: last.ready, words="the work is not done")
    process.new_worker(Adder())
    assert process.behind_s == 0.0


def test_a_new_back_end_takes_the_place_of_one_that_is_closed(process: BackEndProcess):
    first = process.new_worker(Adder())
    assert first.submit(1).result()[0] == 1
    first.close()
    assert process.new_worker(Adder()).submit(2).result()[0] == 2


@pytest.fixture
def gate(tmp_path: Path) -> Path:
    """A pipe: who reads it goes on once it is written to."""
    path = tmp_path / "gate"
    os.mkfifo(path)
    return path


@contextmanager
def copied(process: BackEndProcess, tmp_path: Path) -> Iterator[BackEndProcess]:
    """What a fork of the mapper has of the process, which is asked to copy itself."""
    process.copy(tmp_path / "copy.sock")
    copy = BackEndProcess(patience_s=30.0)
    copy.__dict__.update(process.__dict__)
    copy._answers, copy._former, copy.pid = {}, [], None
    process._listener, copy._channel = None, None
    try:
        yield copy
    finally:
        copy.stop()


def test_the_process_before_ends_and_a_copy_that_it_was_to_make_is_made(
    process: BackEndProcess, tmp_path: Path
):
    worker = process.new_worker(Adder())
    assert worker.submit(1).result()[0] == 1
    first_pid = process.pid
    with copied(process, tmp_path) as copy:
        assert process.new_worker(Adder()).submit(5).result()[0] == 5
        assert os.waitpid(first_pid, 0)[0] == first_pid
        assert ProcessWorker(copy).submit(1000).result()[0] == 1001


def test_when_the_process_is_killed_all_work_is_lost_and_nothing_hangs(
    process: BackEndProcess, caplog: pytest.LogCaptureFixture
):
    worker = process.new_worker(Adder())
    worker.submit(1).result()
    hanging = worker.submit("hang")
    behind = worker.submit(2)
    os.kill(process.pid, signal.SIGKILL)
    for pending in (hanging, behind, worker.submit(3)):
        with pytest.raises(WorkLostError, match="died"):
            pending.result()
    assert "mapping goes on without closing loops" in caplog.text
    assert caplog.text.count("died") == 1


def test_where_a_copy_could_go_on_the_death_of_the_process_is_raised():
    process = BackEndProcess(patience_s=30.0, is_replaceable=lambda: True)
    try:
        worker = process.new_worker(Adder())
        worker.submit(1).result()
        hanging = worker.submit("hang")
        os.kill(process.pid, signal.SIGKILL)
        with pytest.raises(BackEndDiedError, match="process died"):
            hanging.result()
        with pytest.raises(WorkLostError, match="process died"):  # reported once, as the last
            worker.submit(1).result()
    finally:
        process.stop()


def test_a_back_end_that_fails_says_how(process: BackEndProcess):
    pending = process.new_worker(Adder()).submit("raise")
    with pytest.raises(WorkLostError, match="ValueError: cannot add that"):
        pending.result()


def test_waiting_has_an_end(caplog: pytest.LogCaptureFixture):
    process = BackEndProcess(patience_s=0.0)
    try:
        with pytest.raises(WorkLostError, match=r"within 0\.0 s"):
            process.new_worker(Adder()).submit("hang").result()
        assert "within 0.0 s; what it found last is lost" in caplog.text
    finally:
        process.stop()
    wait_until(lambda: process.pid is None or not is_there(process.pid))


def test_the_copy_of_a_back_end_knows_all_up_to_the_copy_and_nothing_after(
    process: BackEndProcess, gate: Path, tmp_path: Path
):
    """Who takes over has the answers that it has not got yet sent again. The back end is at work when it is
    asked to copy itself, and reads that together with the work behind it.
    """
    worker = process.new_worker(Adder())
    assert worker.submit(1).result()[0] == 1
    in_progress = worker.submit(gate)
    with copied(process, tmp_path) as copy:
        behind = worker.submit(100)
        gate.write_bytes(b"go on")
        assert in_progress.result()[0] == 11
        assert behind.result()[0] == 111
        assert ProcessJob(copy, 2).result()[0] == 11
        total, pid = ProcessWorker(copy).submit(1000).result()
        assert (total, pid != process.pid) == (1011, True)
    wait_until(lambda: not is_there(pid))


def test_a_copy_comes_though_its_mapper_died_while_the_back_end_was_at_work(
    process: BackEndProcess, gate: Path, tmp_path: Path
):
    """The answer that no one takes any more is the copy's."""
    worker = process.new_worker(Adder())
    assert worker.submit(1).result()[0] == 1
    worker.submit(gate)
    with copied(process, tmp_path) as copy:
        process._channel.close()
        gate.write_bytes(b"go on")
        assert ProcessJob(copy, 2).result()[0] == 11
        assert ProcessWorker(copy).submit(1000).result()[0] == 1011


def test_a_copy_is_made_after_two_batches_and_gets_those_that_waited(
    process: BackEndProcess, gate: Path, tmp_path: Path
):
    """The mapper is killed while 50 batches have no answer yet, more than a socket takes."""
    worker = process.new_worker(Adder())
    worker.submit(gate)
    for _ in range(50):
        last = worker.submit(b"0" * 100_000)
    with copied(process, tmp_path) as copy:
        copy._is_spare = True
        process._channel.close()
        gate.write_bytes(b"go on")
        wait_until(lambda: ProcessJob(copy, 2).ready)
        assert len(copy._unsent) == 49  # the copy of a stand-by that waits does not do it all again
        copy.need()
        assert ProcessJob(copy, last._number).result()[0] == 10 + 50


def test_a_copy_is_expected_for_as_long_as_the_process_that_makes_it_computes(
    process: BackEndProcess, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    now_s = 100.0
    monkeypatch.setattr(back_end, "time", SimpleNamespace(monotonic=lambda: now_s))
    worker = process.new_worker(Adder())
    worker.submit("compute")
    pid = process.pid
    wait_until(lambda: (alive := look_at(pid)) is not None and alive.cpu_s > 0.1, words="it sleeps")
    with copied(process, tmp_path) as copy:
        copy.need()
        for _ in range(3):
            now_s += back_end.CONNECT_S + 1.0
            copy.look()
            assert copy.fault == ""
        process.stop()
        copy.look()
        now_s += back_end.CONNECT_S + 1.0
        copy.look()
        assert "of the stand-by did not come" in copy.fault


def test_a_copy_that_does_not_come_costs_the_loops_and_nothing_else(
    process: BackEndProcess, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(back_end, "CONNECT_S", 0.1)
    monkeypatch.setattr(back_end, "MEET_S", 0.1)
    worker = process.new_worker(Adder())
    hanging = worker.submit("hang")
    process.copy(tmp_path / "copy.sock")
    process.forked(is_copy=False)
    assert not hanging.ready
    copy = BackEndProcess(patience_s=30.0)
    copy._listener = socket.create_server(str(tmp_path / "unused.sock"), family=socket.AF_UNIX)
    copy.need()
    with pytest.raises(WorkLostError, match="of the stand-by did not come"):
        ProcessWorker(copy).submit(1).result()


ARRAYS_BETWEEN_SMALL_BLOCKS = """
import numpy as np
from service.runtime.back_end import return_freed_memory
def resident_mb():
    return int(open("/proc/self/statm").read().split()[1]) * 4096e-6
return_freed_memory()
np.ones(4_000_000)
arrays, kept = [], []
for _ in range(200):
    arrays.append(np.ones(125_000))
    kept.append(bytearray(5000))
full_mb = resident_mb()
del arrays[:-1]
print(full_mb - resident_mb())
"""


def test_freed_arrays_go_back_to_the_system():
    """Else the back end takes more memory with every lap."""
    command = [sys.executable, "-c", ARRAYS_BETWEEN_SMALL_BLOCKS]
    freed_mb = float(subprocess.run(command, capture_output=True, check=True).stdout)
    assert freed_mb > 150.0
