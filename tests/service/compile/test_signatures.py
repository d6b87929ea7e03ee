import importlib
import pkgutil
from collections.abc import Iterator

import numpy as np
import pytest
from numba import typeof
from numba.core.dispatcher import Dispatcher

import service.kernels
from service.compile import signatures
from service.compile.lazy import DECLARED, load_compiler
from service.compile.signatures import declared_types, jobs_of_process, name_of
from service.kernels.deskew import deskew_points
from service.kernels.likelihood_search import LikelihoodLayer, SearchWindow, search_exhaustive
from service.kernels.tiles import TileIndex
from service.mapper.profiles import import_methods, mapping_config

LOOP_KERNELS = {"align_surfels", "path_lengths", "share_in_free_space", "splat_field", "thin_points"}


def test_every_kernel_with_an_entry_for_python_declares_a_type_for_each_argument():
    import_methods()
    modules = [
        importlib.import_module(f"service.kernels.{module.name}")
        for module in pkgutil.iter_modules(service.kernels.__path__)
    ]
    load_compiler()
    found = (value for module in modules for value in vars(module).values())
    for kernel in {value for value in found if isinstance(value, Dispatcher)}:
        name, options = name_of(kernel), kernel.targetoptions
        if options.get("no_cpython_wrapper") or options.get("inline") == "always":
            assert name not in DECLARED
        else:
            counts = {len(types) for types in declared_types(kernel)}
            assert counts == {kernel.py_func.__code__.co_argcount}, name


def arguments_of_a_search(cell: type[np.floating | np.integer]) -> Iterator[object]:
    tiles = TileIndex(np.zeros((1, 1), np.int32), *(np.zeros(2, t) for t in (np.int64, np.int32, np.int64)))
    yield np.zeros((1, 2))
    yield LikelihoodLayer(tiles, np.zeros((1, 2, 2), cell), 0.0, 0.0, 1.0, 0.1)
    yield SearchWindow(np.zeros(3), 1, 1, 1, 0.1)


@pytest.mark.parametrize("cell", [np.float32, np.uint8])
def test_what_is_declared_are_the_types_of_what_python_passes(cell: type):
    assert tuple(map(typeof, arguments_of_a_search(cell))) in declared_types(search_exhaustive)
    assert len(declared_types(search_exhaustive)) == 2


@pytest.mark.parametrize("xy", [np.zeros((3, 2), np.float32), np.zeros((2, 3)).T, np.zeros((3, 4))[:, ::2]])
def test_a_call_for_types_that_are_not_declared_is_logged_with_the_kernels_name(
    xy: np.ndarray, monkeypatch: pytest.MonkeyPatch
):
    logged: list[str] = []

    class RefusedError(Exception):
        pass

    def refuse(name: str, types: object) -> None:
        logged.append(name)
        raise RefusedError

    monkeypatch.setattr(signatures, "log_undeclared", refuse)
    with pytest.raises(RefusedError):
        deskew_points(xy, np.zeros(3), np.zeros(3), np.zeros((3, 2)))
    assert logged == ["service.kernels.deskew.deskew_points"]


def test_kernels_are_found_from_what_imports_them():
    mapping_config({"profile": "corridor"})
    every, seldom = jobs_of_process()
    live, live_seldom = jobs_of_process(back_end_elsewhere=True)
    assert (every[0].name, live[0].name) == ("match_scan", "match_scan")  # the longest
    assert {job.name for job in every + seldom} >= LOOP_KERNELS
    assert not {job.name for job in live + live_seldom} & LOOP_KERNELS
    assert "search_branch_and_bound" in {job.name for job in live_seldom}
    assert not set(live) & set(live_seldom)
