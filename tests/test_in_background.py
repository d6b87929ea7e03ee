import signal
import subprocess
import sys
from concurrent.futures import Future
from pathlib import Path

import pytest

from tests.in_background import in_background, started

AT_ONCE = """
from tests import conftest

conftest.THREADS_END_S, conftest.EXIT_S, conftest.LIBRARIES_EXIT_S = 0.1, 1, 3
pytest_plugins = ["tests.conftest"]
"""
STAYS = """
import threading

def wait_for_ever():
    threading.Event().wait()

def test_a():
    threading.Thread(target=wait_for_ever, name="laser").start()

def test_b():
    pass
"""


HANGS_AT_EXIT = """
import ctypes

def test_a():
    libc = ctypes.CDLL(None)
    libc.__cxa_atexit(libc.pause, None, None)
"""


def pytest_of(test: str, folder: Path) -> subprocess.CompletedProcess[str]:
    (folder / "conftest.py").write_text(AT_ONCE)
    (folder / "test_a.py").write_text(test)
    command = [sys.executable, "-m", "pytest", "-q", "-c", "/dev/null", f"--rootdir={folder}", folder]
    return subprocess.run(command, capture_output=True, text=True, timeout=100.0, check=False)


def fail() -> None:
    raise ValueError("no laser")


def test_what_a_thread_returns_or_raises_is_its_result():
    assert started(lambda: 7).result(10.0) == 7
    with pytest.raises(ValueError, match="no laser"):
        started(fail).result(10.0)


def test_what_work_in_the_background_raises_is_raised_at_the_end_of_the_block():
    with pytest.raises(ValueError, match="no laser"), in_background(lambda ended: fail()):
        pass


def test_work_that_goes_on_after_the_block_fails_it():
    go_on: Future[None] = Future()
    with (
        pytest.raises(AssertionError, match="still at work 0 s"),
        in_background(lambda _: go_on.result(), 0.1),
    ):
        pass
    go_on.set_result(None)


def test_a_thread_that_stays_fails_its_test_and_does_not_keep_the_process(tmp_path: Path):
    done = pytest_of(STAYS, tmp_path)
    assert done.returncode == 1
    assert "these threads still run: ['laser']" in done.stdout
    assert "2 passed, 1 error" in done.stdout
    assert "in wait_for_ever" in done.stderr


def test_a_library_that_hangs_as_the_process_ends_does_not_keep_it(tmp_path: Path):
    done = pytest_of(HANGS_AT_EXIT, tmp_path)
    assert (done.returncode, "1 passed" in done.stdout) == (-signal.SIGALRM, True)
