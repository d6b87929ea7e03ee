import os
import shutil
import sys
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection, wait
from pathlib import Path

import pytest
from numba.core.caching import _CacheLocator

from service import kernel_warm_up, seldom_kernels
from service.kernel_compiler import load_compiler
from service.kernel_warm_up import warm_up
from service.kernels import branch_and_bound
from service.mapper.profiles import mapping_config
from service.seldom_kernels import LAST, Compiled, SeldomKernels
from tests.service.test_kernel_warm_up import compile_something

WITHIN_S = 600.0  # the process that compiles takes only what processor time nobody else wants
SELDOM = ("build_pyramid", "write_tiles")
COLD = (*SELDOM, "block_sum", "match_scan")  # one that only kernels call, and one of every scan


def drain(seldom: SeldomKernels) -> int:
    """Until it is done; how often it was asked."""
    asked = 0
    while not seldom.is_done:
        if seldom._goes_on and not seldom._compiled:
            assert wait([seldom._ours], WITHIN_S), "nothing more comes, and it has not ended"
        seldom.load_next()
        asked += 1
    return asked


def cache_without(kernels: Sequence[str], place: Path) -> None:
    """All kernels that this process keeps but some, in the place of one that keeps its own."""
    load_compiler()
    known = Path(branch_and_bound.search_branch_and_bound.stats.cache_path)
    folder = place / _CacheLocator.get_suitable_cache_subpath(branch_and_bound.__file__)
    folder.mkdir()
    for path in known.glob("*.nb[ci]"):
        if path.name.split("-")[0].split(".")[-1] not in kernels:
            shutil.copy2(path, folder)


def fails(theirs: Connection, section: object) -> None:
    os._exit(3)


def tells_its_niceness(theirs: Connection, section: object) -> None:
    """In place of the real steps: the names of what is sent are the niceness at which they run."""
    seldom_kernels.seldom_steps = lambda *_, **__: [lambda: None]  # type: ignore[assignment]
    seldom_kernels.compile_seldom(_Named(theirs), {})  # type: ignore[arg-type]


class _Named:
    def __init__(self, theirs: Connection) -> None:
        self._theirs = theirs

    def send(self, step: list[Compiled] | None) -> None:
        if step is not None:
            step = [Compiled("niceness", str(os.getpriority(os.PRIO_PROCESS, 0)), ())]
        self._theirs.send(step)


@pytest.mark.timeout(900)
def test_what_python_calls_seldom_is_compiled_elsewhere_and_loaded_here(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    cache_without(COLD, tmp_path)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    seldom = SeldomKernels(mapping_config())
    loaded: list[str] = []
    load = SeldomKernels.load_next

    def load_and_tell(self: SeldomKernels) -> None:
        self._hear()
        waiting = list(self._compiled)
        load(self)
        if waiting:
            kernel = getattr(sys.modules[waiting[0].module], waiting[0].name)
            assert waiting[0].types in kernel.overloads
            loaded.append(waiting[0].name)

    monkeypatch.setattr(SeldomKernels, "load_next", load_and_tell)
    drain(seldom)
    assert set(SELDOM) <= set(loaded)
    assert "block_sum" not in loaded  # nothing that only kernels call
    assert list(tmp_path.glob("**/branch_and_bound.search_branch_and_bound*.nbi"))
    assert not list(tmp_path.glob("**/match.match_scan*.nbi"))


def test_one_kernel_is_loaded_at_a_time(monkeypatch: pytest.MonkeyPatch):
    done: list[tuple[object, ...]] = []

    class Kernel:
        def compile(self, types: tuple[object, ...]) -> None:
            done.append(types)

    monkeypatch.setattr(seldom_kernels, "made_up", Kernel(), raising=False)
    monkeypatch.setattr(seldom_kernels, "compile_seldom", fails)
    seldom = SeldomKernels(mapping_config())
    seldom._compiled += [Compiled("service.seldom_kernels", "made_up", (k,)) for k in range(2)]
    seldom.load_next()
    assert done == [(0,)]
    assert not seldom.is_done
    drain(seldom)
    assert done == [(0,), (1,)]


def test_a_process_that_died_is_told_of_once(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    monkeypatch.setattr(seldom_kernels, "compile_seldom", fails)
    assert drain(SeldomKernels(mapping_config())) == 1
    assert caplog.text.count("compiled when needed") == 1


def test_it_compiles_at_the_lowest_priority(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(seldom_kernels, "compile_seldom", tells_its_niceness)
    seldom = SeldomKernels(mapping_config())
    while seldom._goes_on:
        assert wait([seldom._ours], WITHIN_S)
        seldom._hear()
    assert seldom._compiled[0].name == str(LAST)


@pytest.mark.parametrize(("compiles", "left_out"), [(True, True), (False, False)])
def test_seldom_kernels_are_left_out_of_a_start_only_where_the_cache_is_cold(
    compiles: bool, left_out: bool, monkeypatch: pytest.MonkeyPatch
):
    done: list[str] = []

    def soon() -> None:
        done.append("soon")
        if compiles:
            compile_something()

    steps: list[Callable[[], None]] = [soon, lambda: done.append("seldom")]
    monkeypatch.setattr(kernel_warm_up, "warm_up_steps", lambda *_: steps)
    monkeypatch.setattr(kernel_warm_up, "seldom_steps", lambda *_: steps[1:])
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {0})
    assert warm_up(leaves_seldom=True) == left_out
    assert done == (["soon"] if left_out else ["soon", "seldom"])
    assert not warm_up()
    assert done[-2:] == ["soon", "seldom"]


def test_a_start_leaves_what_an_earlier_one_had_no_time_to_compile(monkeypatch: pytest.MonkeyPatch):
    done: list[str] = []

    def cut_short() -> None:
        done.append("begun")
        compile_something()
        done.append("compiled")

    steps: list[Callable[[], None]] = [lambda: None, cut_short, lambda: done.append("cached")]
    monkeypatch.setattr(kernel_warm_up, "warm_up_steps", lambda *_: steps)
    monkeypatch.setattr(kernel_warm_up, "seldom_steps", lambda *_: steps[1:])
    assert warm_up(leaves_seldom=True)
    assert done == ["begun", "cached"]
    assert not warm_up()
    assert done[2:] == ["begun", "compiled", "cached"]
