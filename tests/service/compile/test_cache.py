import fcntl
import logging
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from service.compile import cache as kernel_cache
from service.compile.cache import (
    PREFIX,
    cache_folder,
    cache_key,
    compiling_alone,
    ensure_cache_dir,
    forget_kernels,
    is_warm,
    mark_warm,
)
from service.compile.signatures import new_kernel


@pytest.fixture
def sources(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A folder of kernels, and a cache of its own."""
    (sources := tmp_path / "kernels").mkdir()
    (sources / "a.py").write_text("one")
    monkeypatch.setattr(kernel_cache, "KERNELS", sources)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    return sources


@pytest.fixture(autouse=True)
def no_key_stays() -> Iterator[None]:
    cache_key.cache_clear()
    yield
    cache_key.cache_clear()


@pytest.fixture
def no_place(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Neither the sources nor the home can have a cache (a file is in place of each folder)."""
    (tmp_path / "file").write_text("")
    monkeypatch.setattr(kernel_cache, "KERNELS", tmp_path / "file")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    monkeypatch.setenv("NUMBA_CACHE_DIR", "")  # as good as unset, and put back afterwards


def test_the_home_serves_where_the_sources_are_read_only(
    no_place: None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "home"))
    assert ensure_cache_dir() is None
    assert os.environ["NUMBA_CACHE_DIR"] == ""
    assert cache_folder().parent == tmp_path / "home" / "numba"


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
        made = ensure_cache_dir()
    assert cache_folder().parent == made
    assert made.stat().st_mode & 0o777 == 0o700
    assert "compiled again at every start" in caplog.text


def test_a_hidden_cpuinfo_does_not_end_the_start(
    sources: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    """As under a unit with ProcSubset=pid, or in a container."""
    monkeypatch.setattr(kernel_cache, "CPUINFO", tmp_path / "proc" / "cpuinfo")
    assert ensure_cache_dir() is None


def test_kernels_of_other_sources_are_deleted_and_nothing_else(sources: Path):
    """Neither those of another Python nor what else is in the folder, which may be /tmp."""
    ensure_cache_dir()
    compiled, place, key = cache_folder() / "b.f-1.py311.1.nbc", cache_folder().parent, 12 * "0"
    names = ("other_0a1b", f"corridor-kernels-cpython-39-{key}", "corridor-mapper-0a1b", f"{PREFIX}maps")
    foreign = [place / name / "c.nbc" for name in names]
    for path in (compiled, *foreign):
        path.parent.mkdir()
        path.write_bytes(b"machine code")
    ensure_cache_dir()
    assert compiled.exists()
    (sources / "a.py").write_text("two")
    cache_key.cache_clear()
    ensure_cache_dir()
    assert not compiled.exists()
    assert all(path.exists() for path in foreign)


CALLS_ANOTHER_FILE = """
import sys
from collections.abc import Iterator
from pathlib import Path
from service.compile import cache as kernel_cache
kernel_cache.KERNELS = Path(sys.argv[1])
kernel_cache.ensure_cache_dir()
sys.path.insert(0, sys.argv[1])
import numba
import caller
print(caller.answer(), sum(caller.answer.stats.cache_hits.values()))
"""


def test_a_kernel_whose_callee_changed_in_another_file_is_compiled_again(sources: Path, tmp_path: Path):
    head = "from service.compile.lazy import njit\n"
    (sources / "caller.py").write_text(
        head + "from called import one\n@njit(cache=True)\ndef answer():\n    return one()\n"
    )

    def answer(value: int) -> str:
        (sources / "called.py").write_text(head + f"@njit(cache=True)\ndef one():\n    return {value}  #\n")
        command = [sys.executable, "-c", CALLS_ANOTHER_FILE, str(sources)]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout

    assert answer(1) == "1 0\n"
    assert answer(22) == "22 0\n"  # the cache has the file of answer() as it is


def test_a_cache_is_warm_until_sources_or_compiler_change(sources: Path, monkeypatch: pytest.MonkeyPatch):
    ensure_cache_dir()
    cache_folder().mkdir()
    assert not is_warm()
    mark_warm()
    assert is_warm()
    with monkeypatch.context() as other:
        cache_key.cache_clear()
        other.setattr(kernel_cache, "version", lambda name: "0.1")
        assert not is_warm()
    (sources / "a.py").write_text("two")
    cache_key.cache_clear()
    assert not is_warm()
    (sources / "a.py").write_text("one")
    cache_key.cache_clear()
    assert is_warm()
    forget_kernels()
    assert not is_warm()


def test_one_process_at_a_time_compiles_until_all_is_compiled(sources: Path):
    with compiling_alone(), (cache_folder() / "lock").open() as second, pytest.raises(BlockingIOError):
        fcntl.flock(second, fcntl.LOCK_EX | fcntl.LOCK_NB)
    mark_warm()
    (cache_folder() / "lock").unlink()
    with compiling_alone():
        assert not (cache_folder() / "lock").exists()


def test_variants_of_a_kernel_that_two_processes_save_at_a_time_get_a_file_each(
    sources: Path, monkeypatch: pytest.MonkeyPatch
):
    one, other = (new_kernel(lambda cells: cells, {"cache": True})._cache._cache_file for _ in range(2))
    second = threading.Thread(target=other.save, args=("bytes", "code of bytes"))
    load_index = one._load_index

    def interrupted() -> object:
        index = load_index()
        second.start()
        second.join(0.2)  # without a lock it saves now
        return index

    monkeypatch.setattr(one, "_load_index", interrupted)
    one.save("floats", "code of floats")
    second.join()
    assert (other.load("floats"), other.load("bytes")) == ("code of floats", "code of bytes")
