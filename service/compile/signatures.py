"""Which kernels this process calls, and for which types they are compiled.

`@kernel(Float64_2D, SurfelGrid, float)` declares the types of the arguments; here they become numba's. Python
calls the kernels that modules outside of KERNEL_PACKAGE have imported.
"""

import logging
import sys
from collections.abc import Callable, Iterable
from functools import cache, partial
from importlib import import_module
from typing import Annotated, Any, NamedTuple, get_args, get_origin, get_type_hints

import numba
import numpy as np
from numba.core import types
from numba.core.caching import InTreeCacheLocator
from numba.core.dispatcher import Dispatcher
from numba.core.registry import cpu_target
from numba.np.numpy_support import from_dtype

from service.compile.cache import cache_folder, saving_alone
from service.compile.lazy import DECLARED, load_compiler

log = logging.getLogger(__name__)

KERNEL_PACKAGE = "service.kernels."
BACK_END_PACKAGE = ".graph."  # shared, or of one profile
MAX_VARIANTS = 2  # of the arrays in a kernel: a map of floats or of bytes


class Job(NamedTuple):
    """A kernel and which of its declared signatures."""

    module: str
    name: str
    variant: int
    length: int  # bytes of its code: about proportional to the time to compile

    def do(self) -> None:
        """Compile it, or load it from the cache; nothing where this process has it."""
        self._kernel().compile(declared_types(self._kernel())[self.variant])

    def reached(self) -> frozenset[Dispatcher]:
        """The kernel and all that it calls, which are compiled with it."""
        return _reached_from(self._kernel())

    def _kernel(self) -> Any:
        return getattr(import_module(self.module), self.name)


def jobs_of_process(back_end_elsewhere: bool = False) -> tuple[list[Job], list[Job]]:
    """Kernels that the modules imported by now call: with every scan, and seldom; the longest first.

    back_end_elsewhere   leave out what only the graph's back end calls
    """
    load_compiler()
    found: tuple[set[Job], set[Job]] = set(), set()
    for name, module in list(sys.modules.items()):
        if not name.startswith("service.") or name.startswith(KERNEL_PACKAGE) or module is None:
            continue
        if back_end_elsewhere and BACK_END_PACKAGE in name:
            continue
        for kernel in [value for value in list(vars(module).values()) if isinstance(value, Dispatcher)]:
            found[DECLARED[name_of(kernel)].is_seldom].update(_jobs_of(kernel))
    every, seldom = (sorted(jobs, key=lambda job: (-job.length, job)) for jobs in found)
    return every, seldom


class KernelLocator(InTreeCacheLocator):
    """Has numba keep kernels in cache_folder."""

    def get_cache_path(self) -> str:
        return str(cache_folder())


def new_kernel(function: Callable[..., Any], options: dict[str, Any]) -> Any:
    """numba's. A call from Python for types that it does not declare goes to `log_undeclared` first."""
    numba.config.CACHE_LOCATOR_CLASSES = f"{__name__}.KernelLocator"  # type: ignore[attr-defined]
    kernel: Any = numba.njit(**options)(function)
    if options.get("cache"):
        files = kernel._cache._cache_file
        files.save = partial(_save_alone, files.save)
    if name_of(kernel) in DECLARED:
        compile_for_args = kernel._compile_for_args  # called for types without machine code

        def checked(*arguments: Any) -> Any:
            types = tuple(map(kernel.typeof_pyval, arguments))
            if types not in declared_types(kernel):
                log_undeclared(name_of(kernel), types)
            return compile_for_args(*arguments)

        kernel._compile_for_args = checked
    return kernel


def _save_alone(save: Callable[..., None], key: object, data: object) -> None:
    with saving_alone():
        save(key, data)


def log_undeclared(name: str, types: tuple[types.Type, ...]) -> None:
    """A fault of the program: scans wait until it is compiled."""
    log.error("%s is compiled for types that it does not declare; scans wait meanwhile: %s", name, types)


@cache
def declared_types(kernel: Dispatcher) -> tuple[tuple[types.Type, ...], ...]:
    """Of the arguments: one tuple for each signature. Raises KeyError for a kernel of kernels only."""
    hints = DECLARED[name_of(kernel)].types
    every = [tuple(_numba_type(hint, variant) for hint in hints) for variant in range(MAX_VARIANTS)]
    return tuple(dict.fromkeys(every))


def name_of(kernel: Dispatcher) -> str:
    return f"{kernel.py_func.__module__}.{kernel.py_func.__qualname__}"


def start_compiler() -> None:
    """Have numba read its registries, without scipy.

    It would import scipy.linalg only to find out whether np.dot is available, which takes half of the time.
    No kernel multiplies such matrices.
    """
    load_compiler()
    if "scipy.linalg" in sys.modules:
        return
    sys.modules["scipy.linalg"] = None  # type: ignore[assignment]
    try:
        cpu_target.typing_context.refresh()
        cpu_target.target_context.refresh()
    finally:
        del sys.modules["scipy.linalg"]


def code_length(kernels: Iterable[Dispatcher]) -> int:
    """Bytes of Python's code."""
    return sum(len(kernel.py_func.__code__.co_code) for kernel in kernels)


@cache
def _jobs_of(kernel: Dispatcher) -> list[Job]:
    function, length = kernel.py_func, code_length(_reached_from(kernel))
    variants = range(len(declared_types(kernel)))
    return [Job(function.__module__, function.__name__, variant, length) for variant in variants]


@cache
def _reached_from(kernel: Dispatcher) -> frozenset[Dispatcher]:
    names = map(kernel.py_func.__globals__.get, kernel.py_func.__code__.co_names)
    called = {called for called in names if isinstance(called, Dispatcher)}
    return frozenset({kernel}.union(*map(_reached_from, called)))


def _numba_type(hint: Any, variant: int) -> types.Type:
    """Of a NamedTuple, of Annotated[array, Layout, ...], of Annotated[NamedTuple, variant], of a scalar."""
    if get_origin(hint) is Annotated:
        of, *layouts = get_args(hint)
        if isinstance(layouts[0], int):  # of a NamedTuple this variant alone
            return _numba_type(of, layouts[0])
        dtype, ndim, is_readonly = layouts[min(variant, len(layouts) - 1)]
        return types.Array(from_dtype(np.dtype(dtype)), ndim, "C", readonly=is_readonly)
    if issubclass(hint, tuple):
        fields = get_type_hints(hint, include_extras=True).values()
        members = [_numba_type(field, variant) for field in fields]
        return types.BaseTuple.from_types(members, hint)  # type: ignore[no-untyped-call,no-any-return]
    return from_dtype(np.dtype(hint))  # type: ignore[no-any-return]
