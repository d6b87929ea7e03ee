"""Storage for the patches of a map that are far from the vehicle. The mapper itself does no I/O."""

from collections.abc import Callable, Iterable
from typing import Protocol

import numpy as np
import numpy.typing as npt

PatchKey = tuple[int, int]  # row and column of a patch; both may be negative
Cells = npt.NDArray[np.uint8]


class PatchStore(Protocol):
    """Stores the layers of patches unchanged. Every patch has layers of the same shapes."""

    def load(self, key: PatchKey, layers: Iterable[Cells]) -> bool:
        """Copy a patch into these arrays; False, leaving them as they are, if it was not saved."""
        ...

    def save(self, key: PatchKey, layers: Iterable[Cells]) -> None: ...

    def holds(self, key: PatchKey) -> bool: ...

    def expect(self, keys: Iterable[PatchKey]) -> None:
        """Prefetch hint: these may be loaded soon. Returns at once; affects no result."""
        ...


NewPatchStore = Callable[[], PatchStore]


class MemoryPatches:
    """PatchStore in memory: for short drives, tests, and systems without disk space."""

    def __init__(self) -> None:
        self._patches: dict[PatchKey, list[Cells]] = {}

    def load(self, key: PatchKey, layers: Iterable[Cells]) -> bool:
        saved = self._patches.get(key)
        if saved is None:
            return False
        for layer, cells in zip(layers, saved, strict=True):
            layer[...] = cells
        return True

    def save(self, key: PatchKey, layers: Iterable[Cells]) -> None:
        self._patches[key] = [layer.copy() for layer in layers]

    def holds(self, key: PatchKey) -> bool:
        return key in self._patches

    def expect(self, keys: Iterable[PatchKey]) -> None:
        pass
