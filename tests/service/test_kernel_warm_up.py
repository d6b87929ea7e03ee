import gc
import os
import pickle
import subprocess
import sys
import threading
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import pytest
from numba import njit

from service import kernel_warm_up
from service.kernel_warm_up import KernelProgress, needed_kernels, warm_up
from service.mapper.profiles import mapping_config

LOOP_KERNELS = ("align_surfels", "path_lengths", "share_in_free_space", "splat_field", "thin_points")


def helps(theirs: Connection, section: object) -> None:
    theirs.send(None)
    while theirs.recv() is not None:
        theirs.send(None)


def tells(theirs: Connection, section: object) -> None:
    theirs.send("service.kernels.match.match_scan")


def dies(theirs: Connection, section: object) -> None:
    theirs.send(None)
    theirs.recv()
    os._exit(3)


def compile_something() -> None:
    njit(lambda x: x + 1)(1)


@pytest.mark.parametrize(
    ("help_", "warning"), [(helps, ""), (dies, "ended with code 3; its part is compiled here")]
)
def test_what_the_helper_took_is_loaded_here_or_compiled_if_it_died(
    help_: Callable[..., None],
    warning: str,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
):
    done: list[int] = []
    taken = threading.Event()
    claim = kernel_warm_up._Pieces.claim

    def claim_and_tell(self: Any) -> int | None:
        piece = claim(self)
        if threading.current_thread() is not threading.main_thread():
            taken.set()
        return piece

    def first() -> None:
        compile_something()
        assert taken.wait(60.0)
        done.append(0)

    monkeypatch.setattr(kernel_warm_up._Pieces, "claim", claim_and_tell)
    monkeypatch.setattr(
        kernel_warm_up, "warm_up_steps", lambda *_: [first, lambda: done.append(1), lambda: done.append(2)]
    )
    monkeypatch.setattr(kernel_warm_up, "_help", help_)
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {0, 1})
    warm_up()
    assert sorted(done) == [0, 1, 2]
    assert done.index(0) < done.index(1)
    assert warning in caplog.text
    assert bool(warning) == bool(caplog.text)


def test_nobody_helps_where_all_is_in_the_cache(monkeypatch: pytest.MonkeyPatch):
    done: list[int] = []
    monkeypatch.setattr(kernel_warm_up, "warm_up_steps", lambda *_: [lambda: done.append(0)] * 2)
    monkeypatch.setattr(kernel_warm_up, "get_context", lambda method: pytest.fail("a process was begun"))
    warm_up()
    assert done == [0, 0]


@pytest.mark.parametrize("is_enabled", [True, False])
def test_garbage_is_not_sought_while_kernels_are_compiled(is_enabled: bool, monkeypatch: pytest.MonkeyPatch):
    sought: list[bool] = []

    def broken() -> None:
        sought.append(gc.isenabled())
        raise TypeError("cannot lower")

    monkeypatch.setattr(kernel_warm_up, "warm_up_steps", lambda *_: [broken])
    try:
        (gc.enable if is_enabled else gc.disable)()
        with pytest.raises(TypeError, match="cannot lower"):
            warm_up()
        assert gc.isenabled() == is_enabled
    finally:
        gc.enable()
    assert sought == [False]


def test_what_does_not_compile_is_raised(monkeypatch: pytest.MonkeyPatch):
    def broken() -> None:
        raise TypeError("cannot lower")

    monkeypatch.setattr(kernel_warm_up, "warm_up_steps", lambda *_: [broken])
    with pytest.raises(TypeError, match="cannot lower"):
        warm_up()


def test_a_cache_that_was_cut_short_is_emptied_and_filled_anew(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, caplog: pytest.LogCaptureFixture
):
    damaged = tmp_path / "match.match_scan-1.py311.nbi"
    damaged.write_bytes(b"")
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    done: list[int] = []

    def load() -> None:
        if damaged.exists():
            pickle.loads(damaged.read_bytes())
        done.append(1)

    monkeypatch.setattr(kernel_warm_up, "warm_up_steps", lambda *_: [load])
    warm_up()
    assert done == [1]
    assert not damaged.exists()
    assert "all are compiled anew" in caplog.text


def test_what_cannot_be_read_from_an_empty_cache_is_raised(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    def broken() -> None:
        raise EOFError

    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(kernel_warm_up, "warm_up_steps", lambda *_: [broken])
    with pytest.raises(EOFError):
        warm_up()


UNGUARDED = """
from multiprocessing import get_context
from service.kernel_warm_up import _without_main

print("mapped", flush=True)
process = get_context("spawn").Process(target=print, args=("helped",))
with _without_main():
    process.start()
process.join()
"""


def test_the_helper_does_not_run_a_script_once_more(tmp_path: Path):
    (tmp_path / "script.py").write_text(UNGUARDED)
    command = [sys.executable, str(tmp_path / "script.py")]
    ended = subprocess.run(command, capture_output=True, text=True, check=True)
    assert (ended.stdout, ended.stderr) == ("mapped\nhelped\n", "")


def test_what_is_compiled_here_and_by_the_helper_is_told(monkeypatch: pytest.MonkeyPatch):
    told: list[str] = []
    monkeypatch.setattr(kernel_warm_up, "KERNEL_PACKAGE", "")
    monkeypatch.setattr(kernel_warm_up, "warm_up_steps", lambda *_: [compile_something, lambda: None])
    monkeypatch.setattr(kernel_warm_up, "_help", tells)
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {0, 1})
    progress = KernelProgress(lambda p: told.append(str(p).partition(" of")[0]))
    warm_up(progress=progress)
    assert told == ["compiling kernels: 1", "compiling kernels: 2"]


def test_progress_counts_each_kernel_once_and_nothing_else():
    shares: list[float] = []
    progress = KernelProgress(lambda p: shares.append(p.share))
    assert str(progress) == "loading kernels, 0 s"
    progress.expect(4)
    for name in ("service.kernels.a.f", "service.kernels.b.g", "service.kernels.a.f", "numba.np.empty"):
        progress.compiled(name)
    assert shares == [0.25, 0.5, 0.5]
    assert str(progress) == "compiling kernels: 2 of 4, 0 s"


def test_kernels_that_a_config_needs_are_known_from_who_calls_them():
    mapping_config({"profile": "corridor"})
    every, live = needed_kernels(), needed_kernels(back_end_elsewhere=True)
    assert {"service.kernels.match.match_scan", "service.kernels.linear3.solve_3x3"} <= live
    of_the_back_end = {f"service.kernels.loops.{name}" for name in LOOP_KERNELS}
    assert of_the_back_end <= every
    assert of_the_back_end.isdisjoint(live)


# Called beside the stream of scans only: in a stored map, when loops have closed, by another profile.
NOT_WITH_SCANS = {"weigh_changes", "take_slot", "write_tiles"}
NOT_LOADED = """
import sys
from numba.core.registry import CPUDispatcher
from service.kernel_warm_up import warm_up
from service.mapper.profiles import mapping_config
warm_up(mapping_config(), back_end_elsewhere=True)
for name, module in list(sys.modules.items()):
    if name.startswith("service.") and not name.startswith("service.kernels") and ".graph" not in name:
        for kernel in vars(module).values():
            if isinstance(kernel, CPUDispatcher) and not kernel.overloads:
                print(kernel.py_func.__name__)
"""


def test_no_kernel_that_a_scan_may_need_is_left_to_the_first_scan():
    """One of them took 0.45 s of the first second of a drive."""
    ended = subprocess.run([sys.executable, "-c", NOT_LOADED], capture_output=True, text=True, check=True)
    assert set(ended.stdout.split()) <= NOT_WITH_SCANS
