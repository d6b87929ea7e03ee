"""numba's njit, imported with the first call of a kernel.

The import takes 0.2 s of processor time. What only checks a config, or leaves mapping to another process,
calls no kernel and does without.
"""

import functools
import sys
import threading
from collections.abc import Callable
from typing import Any

PACKAGES = ("service", "simulators", "tests")  # whose modules import kernels

_lock = threading.RLock()
_waiting: list["WaitingKernel"] = []


def njit(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """As numba's; a function that is decorated before numba is imported waits for the first call of any."""

    def decorate(function: Callable[..., Any]) -> Any:
        if "numba" in sys.modules:
            load_compiler()  # by whomever it was imported: a kernel may call only kernels of numba
            return _compiled(function, options)
        _waiting.append(WaitingKernel(function, options))
        return _waiting[-1]

    return decorate


def load_compiler() -> None:
    """Put numba's kernels in the places of those that wait, in each module that has imported one."""
    with _lock:
        if not _waiting:
            return
        for kernel in _waiting:
            kernel.load()
        for name, module in list(sys.modules.items()):
            if module is None or name.partition(".")[0] not in PACKAGES:
                continue
            for word, value in list(vars(module).items()):
                if isinstance(value, WaitingKernel):
                    setattr(module, word, value.load())
        _waiting.clear()


class WaitingKernel:
    """A kernel before numba is imported. Who has kept one may call it afterwards, too."""

    def __init__(self, function: Callable[..., Any], options: dict[str, Any]) -> None:
        functools.update_wrapper(self, function)
        self._function = function
        self._options = options
        self._kernel: Any = None

    def load(self) -> Any:
        """numba's kernel, always the same."""
        if self._kernel is None:
            self._kernel = _compiled(self._function, self._options)
        return self._kernel

    def __call__(self, *arguments: Any) -> Any:
        load_compiler()
        return self.load()(*arguments)


def _compiled(function: Callable[..., Any], options: dict[str, Any]) -> Any:
    import numba

    return numba.njit(**options)(function)
