"""Fixtures that every test file may use."""

import faulthandler
import gc
import logging
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import hypothesis
import pytest

from service.compile.cache import ensure_cache_dir, is_warm
from tests.shared_data import NO_RECORDINGS, SHARED
from tests.soaked import FEW_EXAMPLES, MANY_EXAMPLES

gc.disable()  # until all is imported, which makes no garbage but would be looked through over and over
ensure_cache_dir()  # before anything imports numba: what is compiled from now on is kept

ROOT = Path(__file__).parents[1]
THREADS_END_S = 10.0
EXIT_S = 60  # for the interpreter, after the last test
LIBRARIES_EXIT_S = 70  # then for libraries
YOUNG_OBJECTS = 20_000  # between searches for garbage: one each 700 takes a twentieth of the processor time

# Without a deadline: a core may be busy with other things. Few examples are the same each time, so that a run
# goes as the one before; chance has its place in `make soak`.
hypothesis.settings.register_profile(
    "corridor", deadline=None, max_examples=FEW_EXAMPLES, derandomize=True, database=None
)
hypothesis.settings.register_profile("thorough", deadline=None, max_examples=MANY_EXAMPLES)  # `make soak`
hypothesis.settings.load_profile("corridor")


# Variable -> words of reasons to skip: where it is set, who would skip for such a reason fails.
NEEDS = {
    "CORRIDOR_NEEDS_SHARED": ("no real recordings",),
    "CORRIDOR_NEEDS_BROWSER": ("no Chromium", "no axe-core"),
}
RUNS_THE_PROGRAM = ("tests/system", "tests/chaos", "tests/browser", "tests/docs", "tests/service/cli")


def pytest_collection_finish(session: pytest.Session) -> None:
    """Compile all kernels before the first test where they are not in the cache: on every core, under no
    test's time-out.
    """
    gc.freeze()  # what stands now stands to the end
    gc.set_threshold(YOUNG_OBJECTS)
    gc.enable()
    nodes = [item.nodeid for item in session.items]
    wanted = any(name.startswith("service.kernels.") for name in sys.modules) or any(
        node.startswith(RUNS_THE_PROGRAM) for node in nodes
    )
    if not nodes or not wanted or session.config.option.collectonly or is_warm():
        return
    reporter: Any = session.config.pluginmanager.get_plugin("terminalreporter")
    with session.config.pluginmanager.get_plugin("capturemanager").global_and_fixture_disabled():
        reporter.write_line("the kernels are compiled first, once, in a minute or two")
        subprocess.run([sys.executable, "-m", "service", "warmup"], cwd=ROOT, check=True)


def pytest_unconfigure() -> None:
    """End the process, with its threads' stacks, where a thread or a library keeps it alive.

    Python's watchdog goes with the interpreter; the alarm stands while libraries end, too.
    """
    sys.stdout.flush()
    faulthandler.dump_traceback_later(EXIT_S, exit=True, file=sys.__stderr__)
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.alarm(LIBRARIES_EXIT_S)


@pytest.fixture(autouse=True)
def _no_undeclared_kernel(monkeypatch: pytest.MonkeyPatch) -> None:
    """A call of a kernel for types that it does not declare fails."""
    if "numba" in sys.modules:
        from service.compile import signatures

        monkeypatch.setattr(signatures, "log_undeclared", _refuse)


def _refuse(name: str, types: tuple[object, ...]) -> None:
    raise TypeError(f"{name} is not declared for {types}")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]) -> Any:
    """A skip for want of what has to be there, see NEEDS, is a failure."""
    report = yield
    if report.skipped:
        for variable, reasons in NEEDS.items():
            if os.environ.get(variable) and any(reason in str(report.longrepr) for reason in reasons):
                report.outcome = "failed"
                report.longrepr = f"{variable} is set: {report.longrepr}"
    return report


@pytest.fixture(scope="session")
def shared() -> Path:
    """Folder of real captures and recordings, else a skip says so."""
    if not (SHARED / "captures").is_dir():
        pytest.skip(NO_RECORDINGS)
    return SHARED


@pytest.fixture(autouse=True)
def no_thread_stays() -> Iterator[None]:
    """A thread that is no daemon keeps the process alive; Zenoh calls back in such threads, too."""
    before = set(threading.enumerate())
    yield
    until_s = time.monotonic() + THREADS_END_S
    stays = [one for one in threading.enumerate() if one not in before and not one.daemon]
    for one in stays:
        one.join(max(until_s - time.monotonic(), 0.0))
    left = [one.name for one in stays if one.is_alive()]
    assert not left, f"{THREADS_END_S:.0f} s after the test these threads still run: {left}"


@pytest.fixture(autouse=True)
def logging_as_before() -> Iterator[None]:
    """Commands configure these loggers: the next test sees neither their level nor a closed stream."""
    root, drivers = logging.getLogger(), logging.getLogger("drivers")
    handlers, level, of_drivers = root.handlers[:], root.level, drivers.level
    yield
    root.handlers[:] = handlers
    root.setLevel(level)
    drivers.setLevel(of_drivers)  # doctor and init raise it
