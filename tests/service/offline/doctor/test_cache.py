import os
import subprocess
import sys
from pathlib import Path

import pytest

from service.kernel_cache import KERNELS
from service.offline.doctor import cache
from service.offline.doctor.cache import look_at_cache
from tests.service.offline.doctor.conftest import FakeTree

COMPILE_ONE = """
import numpy as np
from service.kernels.deskew import deskew_points
deskew_points(np.zeros((1, 2)), np.zeros(1), np.zeros(3), np.zeros((1, 2)))
"""


@pytest.fixture
def place(tmp_path: Path) -> Path:
    return tmp_path / "numba"


def test_a_cold_cache_is_noted(tree: FakeTree, place: Path):
    finding = look_at_cache(tree.machine(environment={"NUMBA_CACHE_DIR": str(place)}))
    assert finding.severity == "note"
    assert finding.measured.startswith("0 of ")
    assert finding.remedy == "corridor warmup"
    assert not place.exists()


def test_what_numba_really_wrote_is_recognised(tree: FakeTree, place: Path):
    environment = os.environ | {"NUMBA_CACHE_DIR": str(place)}
    subprocess.run([sys.executable, "-c", COMPILE_ONE], env=environment, check=True, timeout=100)
    finding = look_at_cache(tree.machine(environment=environment))
    assert finding.measured.startswith("1 of ")


def test_a_cache_with_every_kernel_is_good_and_one_older_than_its_source_is_not(tree: FakeTree, place: Path):
    python = f"py{sys.version_info.major}{sys.version_info.minor}"
    (place / "kernels_1f").mkdir(parents=True)
    for source in KERNELS.glob("*.py"):
        for function, line in cache._cached_functions(source):
            (place / f"kernels_1f/{source.stem}.{function}-{line}.{python}.nbi").touch()
    machine = tree.machine(environment={"NUMBA_CACHE_DIR": str(place)})
    finding = look_at_cache(machine)
    assert finding.severity == "ok"
    total = int(finding.values["kernels"])
    assert total >= 20
    stale = next(place.glob("**/linear3.solve*.nbi"))
    os.utime(stale, (0.0, 0.0))
    assert look_at_cache(machine).measured.startswith(f"{total - 1} of {total} ")


def test_no_place_for_kernels_is_a_fault(tree: FakeTree, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(cache, "cannot_write", lambda folder: "Permission denied")
    finding = look_at_cache(tree.machine())
    assert finding.severity == "fault"
    assert "home/.cache/numba" in finding.measured
    assert "NUMBA_CACHE_DIR" in finding.remedy


def test_only_functions_that_numba_keeps_are_counted(tmp_path: Path):
    source = tmp_path / "kernel.py"
    source.write_text(
        "@njit(cache=True,\n      nogil=True)\ndef kept(x):\n    return x\n\n\n"
        "@njit(nogil=True)\ndef compiled_anew(x):\n    return x\n\n\n"
        "@kernel\ndef called(x):\n    return x\n\n\n@inner_kernel\ndef inner(x):\n    return x\n\n\n"
        "@vectorised\ndef other(x):\n    return x\n\n\ndef plain(x):\n    return x\n"
    )
    assert cache._cached_functions(source) == [("kept", 1), ("called", 12), ("inner", 17)]
