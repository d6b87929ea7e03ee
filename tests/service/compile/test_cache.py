import fcntl
import logging
import os
import subprocess
import sys
from pathlib import Path

import pytest

from service.compile import cache as kernel_cache


@pytest.fixture
def no_place(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Neither the sources nor the home can hold a cache (a file is in the way of each folder)."""
    (tmp_path / "file").write_text("")
    monkeypatch.setattr(kernel_cache, "KERNELS", tmp_path / "file")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    monkeypatch.setenv("NUMBA_CACHE_DIR", "")  # as good as unset, and put back afterwards


def test_a_writable_place_is_left_alone(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "new"))
    assert kernel_cache.ensure_cache_dir() is None
    assert os.environ["NUMBA_CACHE_DIR"] == str(tmp_path / "new")


def test_the_home_serves_where_the_sources_are_read_only(
    no_place: None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "home"))
    assert kernel_cache.ensure_cache_dir() is None
    assert os.environ["NUMBA_CACHE_DIR"] == ""


@pytest.mark.parametrize("given", ["", "below/it"])
def test_without_a_place_a_private_one_is_made_with_a_warning(
    given: str,
    no_place: None,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
):
    if given:
        monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "file" / given))
    with caplog.at_level(logging.WARNING):
        made = kernel_cache.ensure_cache_dir()
    assert made is not None
    assert os.environ["NUMBA_CACHE_DIR"] == str(made)
    assert made.stat().st_mode & 0o777 == 0o700
    assert "compiled again at every start" in caplog.text


@pytest.mark.parametrize("folder", ["", "kernels_0a1b"])
def test_kernels_of_other_sources_are_forgotten(folder: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """numba would keep a kernel whose own file is the same, though it calls one that changed."""
    sources, cache = tmp_path / "kernels", tmp_path / "cache"
    sources.mkdir()
    (sources / "a.py").write_text("one")
    monkeypatch.setattr(kernel_cache, "KERNELS", sources)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(cache))
    kernel_cache.ensure_cache_dir()
    (cache / folder).mkdir(exist_ok=True)
    compiled, foreign = cache / folder / "b.f-1.py311.1.nbc", cache / "other_0a1b" / "c.nbc"
    foreign.parent.mkdir()
    for path in (compiled, foreign):
        path.write_bytes(b"machine code")
    kernel_cache.ensure_cache_dir()
    assert compiled.exists()
    (sources / "a.py").write_text("two")
    kernel_cache.ensure_cache_dir()
    assert not compiled.exists()
    assert foreign.exists()


CALLS_ANOTHER_FILE = """
import sys
from pathlib import Path
from service.compile import cache as kernel_cache
kernel_cache.KERNELS = Path(sys.argv[1])
kernel_cache.ensure_cache_dir()
sys.path.insert(0, sys.argv[1])
import caller
print(caller.answer(), sum(caller.answer.stats.cache_hits.values()))
"""


def test_a_kernel_whose_callee_changed_in_another_file_is_compiled_again(tmp_path: Path):
    sources = tmp_path / "kernels"
    sources.mkdir()
    head = "from numba import njit\n"
    (sources / "caller.py").write_text(
        head + "from called import one\n@njit(cache=True)\ndef answer():\n    return one()\n"
    )
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "cache")}

    def answer(value: int) -> str:
        (sources / "called.py").write_text(head + f"@njit(cache=True)\ndef one():\n    return {value}  #\n")
        command = [sys.executable, "-c", CALLS_ANOTHER_FILE, str(sources)]
        return subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout

    assert answer(1) == "1 0\n"
    assert answer(1) == "1 1\n"  # from the cache
    assert answer(22) == "22 0\n"


def test_a_cache_is_warm_until_sources_place_or_compiler_change(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    sources = tmp_path / "kernels"
    sources.mkdir()
    (sources / "a.py").write_text("one")
    monkeypatch.setattr(kernel_cache, "KERNELS", sources)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    kernel_cache.ensure_cache_dir()
    assert not kernel_cache.is_warm()
    kernel_cache.mark_warm()
    assert kernel_cache.is_warm()
    with monkeypatch.context() as other:
        other.setattr(kernel_cache, "version", lambda name: "0.1")
        assert not kernel_cache.is_warm()
    (sources / "a.py").write_text("two")
    assert not kernel_cache.is_warm()
    (sources / "a.py").write_text("one")
    assert kernel_cache.is_warm()
    with monkeypatch.context() as other:  # numba keeps kernels by the path of their sources
        other.setattr(kernel_cache, "KERNELS", sources.rename(tmp_path / "moved"))
        assert not kernel_cache.is_warm()
    (tmp_path / "moved").rename(sources)
    kernel_cache.forget_kernels()
    assert not kernel_cache.is_warm()


def test_one_process_at_a_time_compiles_until_all_is_compiled(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    with (
        kernel_cache.compiling_alone(),
        (tmp_path / kernel_cache.LOCK_NAME).open() as second,
        pytest.raises(BlockingIOError),
    ):
        fcntl.flock(second, fcntl.LOCK_EX | fcntl.LOCK_NB)
    kernel_cache.mark_warm()
    (tmp_path / kernel_cache.LOCK_NAME).unlink()
    with kernel_cache.compiling_alone():
        assert not (tmp_path / kernel_cache.LOCK_NAME).exists()
