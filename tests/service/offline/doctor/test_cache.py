from pathlib import Path

import pytest

from service.compile import cache as kernel_cache
from service.offline.doctor.cache import look_at_cache
from tests.service.offline.doctor.conftest import FakeTree


@pytest.fixture
def place(tmp_path: Path) -> Path:
    return tmp_path / "numba"


def test_a_cache_is_good_once_all_is_compiled_and_until_a_source_changes(
    tree: FakeTree, place: Path, monkeypatch: pytest.MonkeyPatch
):
    environment = {"NUMBA_CACHE_DIR": str(place)}
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(place))
    kernel_cache.ensure_cache_dir()
    kernel_cache.cache_folder().mkdir()
    for name in ("one", "two"):
        (kernel_cache.cache_folder() / f"deskew.{name}-1.py311.nbi").touch()
    assert look_at_cache(tree.machine(environment=environment)).measured.startswith("2 kernels ")
    kernel_cache.mark_warm()
    finding = look_at_cache(tree.machine(environment=environment))
    assert (finding.severity, finding.values["kernels"]) == ("ok", 2)
    monkeypatch.setattr(kernel_cache, "cache_key", lambda: "of other sources")
    finding = look_at_cache(tree.machine(environment=environment))
    assert finding.severity == "note"
    assert finding.measured.startswith("0 kernels ")
