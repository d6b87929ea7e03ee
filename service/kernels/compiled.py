"""Decorators that compile functions to kernels.

numba generates for each function a wrapper for Python, which unpacks all arrays and tuples, and one for C.
For a small function of many arrays these take longer to compile than the function. It also rewrites
expressions of whole arrays, which kernels do not have.
"""

from collections.abc import Callable
from typing import Any

from service.compile.lazy import DECLARED, Declaration, njit

OPTIONS: dict[str, Any] = {"cache": True, "nogil": True, "no_cfunc_wrapper": True, "no_rewrites": True}
INNER_OPTIONS = {**OPTIONS, "no_cpython_wrapper": True}


def kernel(*types: Any) -> Callable[[Callable[..., Any]], Any]:
    """A kernel called from Python and from other kernels.

    types   of the arguments, for which it is compiled before the first scan: arrays of arrays.py, NamedTuples
        of these, scalars
    """
    return _declared(types, is_seldom=False)


def seldom_kernel(*types: Any) -> Callable[[Callable[..., Any]], Any]:
    """As kernel, but compiled after the first scans: few scans call it."""
    return _declared(types, is_seldom=True)


def inner_kernel(function: Callable[..., Any]) -> Any:
    """A kernel called by other kernels only, without a wrapper for Python."""
    return njit(**INNER_OPTIONS)(function)


def inlined_kernel(function: Callable[..., Any]) -> Any:
    """As inner_kernel, but numba copies it into its callers: for short functions of inner loops.

    A call costs as much as such a function where arrays are passed, each of which numba counts references of.
    """
    return njit(**INNER_OPTIONS, inline="always")(function)


def _declared(types: tuple[Any, ...], is_seldom: bool) -> Callable[[Callable[..., Any]], Any]:
    def decorate(function: Callable[..., Any]) -> Any:
        DECLARED[f"{function.__module__}.{function.__qualname__}"] = Declaration(types, is_seldom)
        return njit(**OPTIONS)(function)

    return decorate
