import os
from pathlib import Path

import numpy as np

from service.mapstore.patch_files import PatchFiles

SHAPES = ((100, 100), (20, 20))


def layers(seed: int) -> tuple[np.ndarray, ...]:
    noise = np.random.default_rng(seed)
    return tuple(noise.integers(0, 255, shape).astype(np.uint8) for shape in SHAPES)


def nothing() -> tuple[np.ndarray, ...]:
    return tuple(np.zeros(shape, np.uint8) for shape in SHAPES)


def test_patches_come_back_as_they_were_whatever_file_they_are_in(tmp_path: Path) -> None:
    store = PatchFiles(tmp_path)
    keys = [(row, column) for row in range(-25, 26, 5) for column in range(-25, 26, 5)]
    for seed, key in enumerate(keys):
        assert not store.holds(key)
        store.save(key, layers(seed))
    assert os.listdir(tmp_path) == []  # a service that dies leaves nothing behind
    for seed, key in enumerate(keys):
        found = nothing()
        assert store.load(key, found)
        for cells, expected in zip(found, layers(seed), strict=True):
            np.testing.assert_array_equal(cells, expected)


def test_a_full_disk_keeps_the_patch_in_memory_and_says_so(monkeypatch, caplog) -> None:
    def refuse(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "posix_fallocate", refuse)
    store = PatchFiles()
    store.save((3, 4), layers(1))
    assert "no room on disk" in caplog.text
    found = nothing()
    assert store.holds((3, 4))
    assert store.load((3, 4), found)
    np.testing.assert_array_equal(found[0], layers(1)[0])
