"""Patches of a map in memory-mapped files: one file for 10 x 10 patches, as many as the map has come to need.

The files have no name: they are unlinked when they are made, so a service that dies leaves nothing behind.
They lie in TMPDIR (else /tmp); where that is in memory, point TMPDIR to a disk. Only what is being copied
stands in the memory of the process: pages go back after each patch, and files far away are unmapped.
"""

import logging
import mmap
import os
import tempfile
import weakref
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from service.mapper.patch_store import Cells, MemoryPatches, PatchKey

log = logging.getLogger(__name__)

ACROSS = 10  # patches along the edge of a file
MAPPED_FILES = 4  # at a corner four meet


class PatchFiles:
    """PatchStore on disk. Where the disk is full, patches stay in memory, and the log reports it."""

    def __init__(self, directory: Path | None = None) -> None:
        self._directory = directory
        self._saved: set[PatchKey] = set()
        self._files: dict[PatchKey, int] = {}  # descriptors
        self._mapped: dict[PatchKey, mmap.mmap] = {}  # the one used longest ago first
        self._patch_bytes = 0
        self._left_over = MemoryPatches()  # what the disk refused
        weakref.finalize(self, _close_all, self._files)

    def load(self, key: PatchKey, layers: Iterable[Cells]) -> bool:
        if key not in self._saved:
            return self._left_over.load(key, layers)
        file, begin = self._place(key)
        memory = self._map(file)
        at = begin
        for layer in layers:
            layer[...] = np.frombuffer(memory, np.uint8, layer.size, at).reshape(layer.shape)
            at += layer.size
        self._hand_back(memory, begin)
        return True

    def save(self, key: PatchKey, layers: Iterable[Cells]) -> None:
        layers = list(layers)
        self._patch_bytes = sum(layer.size for layer in layers)
        file, begin = self._place(key)
        try:
            self._make_room(file, begin)
        except OSError as error:
            log.warning(
                "map: no room on disk for a patch of %d bytes in %s (%s); it stays in memory. "
                "Free space there, or point TMPDIR to a larger disk",
                self._patch_bytes,
                self._directory or tempfile.gettempdir(),
                error,
            )
            self._left_over.save(key, layers)
            return
        memory = self._map(file)
        at = begin
        for layer in layers:
            np.frombuffer(memory, np.uint8, layer.size, at)[:] = layer.ravel()
            at += layer.size
        self._hand_back(memory, begin)
        self._saved.add(key)

    def holds(self, key: PatchKey) -> bool:
        return key in self._saved or self._left_over.holds(key)

    def expect(self, keys: Iterable[PatchKey]) -> None:
        """Let the system read them from the disk while the mapper goes on."""
        for key in keys:
            if key in self._saved:
                file, begin = self._place(key)
                first = begin - begin % mmap.PAGESIZE
                self._map(file).madvise(mmap.MADV_WILLNEED, first, begin - first + self._patch_bytes)

    @property
    def disk_bytes(self) -> int:
        """What the files take on the disk, in blocks of the file system."""
        return sum(os.fstat(file).st_blocks * 512 for file in self._files.values())

    def _place(self, key: PatchKey) -> tuple[PatchKey, int]:
        (file_row, row), (file_column, column) = divmod(key[0], ACROSS), divmod(key[1], ACROSS)
        return (file_row, file_column), (row * ACROSS + column) * self._patch_bytes

    def _make_room(self, key: PatchKey, begin: int) -> None:
        """Blocks for a patch: writing to a mapped file that finds none would kill the process."""
        if key not in self._files:
            with tempfile.TemporaryFile(prefix="corridor-map-", dir=self._directory) as file:
                self._files[key] = os.dup(file.fileno())
            os.ftruncate(self._files[key], ACROSS * ACROSS * self._patch_bytes)
        os.posix_fallocate(self._files[key], begin, self._patch_bytes)

    def _map(self, key: PatchKey) -> mmap.mmap:
        memory = self._mapped.pop(key, None)
        if memory is None:
            if len(self._mapped) >= MAPPED_FILES:
                self._mapped.pop(next(iter(self._mapped))).close()
            memory = mmap.mmap(self._files[key], 0)
        self._mapped[key] = memory
        return memory

    def _hand_back(self, memory: mmap.mmap, begin: int) -> None:
        """The pages of a patch leave the process, not the file."""
        first = begin - begin % mmap.PAGESIZE
        memory.madvise(mmap.MADV_DONTNEED, first, begin - first + self._patch_bytes)


def _close_all(files: dict[PatchKey, int]) -> None:
    for file in files.values():
        os.close(file)
