"""numba's njit, imported with the first call of a kernel.

The import takes 0.2 s of processor time. What only checks a config, or leaves mapping to another process,
calls no kernel and does without.
"""

import sys
import threading
from collections.abc import Callable
from functools import cached_property, update_wrapper
from typing import Any, NamedTuple

PACKAGES = ("service", "simulators", "tests")  # whose modules import kernels


class Layout(NamedTuple):
    """Of a C-contiguous array that a kernel takes."""

    dtype: type
    ndim: int
    is_readonly: bool = False


class Declaration(NamedTuple):
    """Stands beside a kernel that Python calls."""

    types: tuple[Any, ...]  # of the arguments: NamedTuple, scalar, or array annotated with a Layout
    is_seldom: bool  # not every scan calls it


DECLARED: dict[str, Declaration] = {}  # by module and name
_lock = threading.RLock()
_waiting: list["WaitingKernel"] = []


def njit(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """As numba's; a function that is decorated before numba is imported waits for the first call of any."""

    def decorate(function: Callable[..., Any]) -> Any:
        kernel = WaitingKernel(function, options)
        _waiting.append(kernel)
        if "numba" in sys.modules:
            load_compiler()  # a kernel may call only kernels of numba
            return kernel.loaded
        return kernel

    return decorate


def load_compiler() -> None:
    """Replace the kernels that wait by numba's, in each module that has imported one."""
    with _lock:
        if not _waiting:
            return
        for kernel in _waiting:
            kernel.loaded  # noqa: B018 - numba looks for the kernels that a kernel calls when it compiles
        modules = [module for name, module in list(sys.modules.items()) if name.split(".")[0] in PACKAGES]
        for module in filter(None, modules):
            kernels = {k: v.loaded for k, v in vars(module).items() if isinstance(v, WaitingKernel)}
            vars(module).update(kernels)
        _waiting.clear()


class WaitingKernel:
    """A kernel before numba is imported. It can be called afterwards, too."""

    def __init__(self, function: Callable[..., Any], options: dict[str, Any]) -> None:
        update_wrapper(self, function)
        self._function, self._options = function, options

    @cached_property
    def loaded(self) -> Any:
        """numba's kernel."""
        from service.compile.signatures import new_kernel

        return new_kernel(self._function, self._options)

    def __call__(self, *arguments: Any) -> Any:
        load_compiler()
        return self.loaded(*arguments)
