"""How functions become kernels.

numba gives each function an entry for Python, which takes every array and tuple apart, and one for C. Both
are compiled too, and for a small function of many arrays that takes longer than the function itself. It also
searches each function for expressions of whole arrays, to fuse their loops; kernels have loops of their own.
"""

from collections.abc import Callable
from typing import Any

from service.compile.lazy import DECLARED, Declaration, njit

OPTIONS: dict[str, Any] = {"cache": True, "nogil": True, "no_cfunc_wrapper": True, "no_rewrites": True}
INNER_OPTIONS = {**OPTIONS, "no_cpython_wrapper": True}


def kernel(*types: Any) -> Callable[[Callable[..., Any]], Any]:
    """A kernel that Python and other kernels call.

    types   of the arguments as Python passes them, for which it is compiled before the first scan: arrays of
        arrays.py, NamedTuples of these, scalars
    """
    return _declared(types, is_seldom=False)


def seldom_kernel(*types: Any) -> Callable[[Callable[..., Any]], Any]:
    """As kernel; not every scan calls it, so the first scans do not wait for it to be compiled."""
    return _declared(types, is_seldom=True)


def inner_kernel(function: Callable[..., Any]) -> Any:
    """A kernel that only other kernels call: it has no entry for Python."""
    return njit(**INNER_OPTIONS)(function)


def _declared(types: tuple[Any, ...], is_seldom: bool) -> Callable[[Callable[..., Any]], Any]:
    def decorate(function: Callable[..., Any]) -> Any:
        DECLARED[f"{function.__module__}.{function.__qualname__}"] = Declaration(types, is_seldom)
        return njit(**OPTIONS)(function)

    return decorate
