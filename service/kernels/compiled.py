"""How functions become kernels.

numba gives each function an entry for Python, which takes every array and tuple apart, and one for C. Both
are compiled too, and for a small function of many arrays that takes longer than the function itself. It also
searches each function for expressions of whole arrays, to fuse their loops; kernels have loops of their own.
"""

from collections.abc import Callable
from typing import Any

from service.kernel_compiler import njit

OPTIONS: dict[str, Any] = {"cache": True, "nogil": True, "no_cfunc_wrapper": True, "no_rewrites": True}
INNER_OPTIONS = {**OPTIONS, "no_cpython_wrapper": True}


def kernel(function: Callable[..., Any]) -> Any:
    """A kernel that Python and other kernels call."""
    return njit(**OPTIONS)(function)


def inner_kernel(function: Callable[..., Any]) -> Any:
    """A kernel that only other kernels call: it has no entry for Python."""
    return njit(**INNER_OPTIONS)(function)
