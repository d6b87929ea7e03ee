"""Kernels that have no entry for Python, with one."""

from collections.abc import Callable
from typing import Any

from service.compile.lazy import WaitingKernel, load_compiler, njit


def from_python(inner: Callable[..., Any]) -> Callable[..., Any]:
    """A kernel that does nothing but call an inner one."""
    load_compiler()
    kernel = inner.loaded if isinstance(inner, WaitingKernel) else inner
    call: Callable[..., Any] = njit()(lambda *arguments: kernel(*arguments))
    return call
