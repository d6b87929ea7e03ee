import logging
import os
import select
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest
from numba.core.caching import _CacheLocator

from service.compile import worker
from service.compile.lazy import load_compiler
from service.compile.seldom import LAST, SeldomKernels
from service.compile.signatures import Job, jobs_of_process
from service.kernels import branch_and_bound
from service.mapper.profiles import mapping_config

WITHIN_S = 600.0  # the process that compiles takes only what processor time no one else wants
COLD = ("build_pyramid", "write_tiles", "match_scan")  # the last is called with every scan


def drain(seldom: SeldomKernels) -> int:
    """Until it is done; how often it was asked."""
    asked = 0
    while not seldom.is_done:
        if (process := seldom._worker) is not None:
            assert select.select([process.stdout], [], [], WITHIN_S)[0], "nothing more comes"
        seldom.load_next()
        asked += 1
    return asked


def cache_without(kernels: Sequence[str], place: Path) -> None:
    """All kernels that this process keeps but some, in the place of one that keeps its own."""
    load_compiler()
    known = Path(branch_and_bound.search_branch_and_bound.stats.cache_path)
    folder = place / _CacheLocator.get_suitable_cache_subpath(branch_and_bound.__file__)
    folder.mkdir()
    for path in known.glob("*.nb[ci]"):
        if path.name.split("-")[0].split(".")[-1] not in kernels:
            shutil.copy2(path, folder)


@pytest.mark.timeout(900)
def test_seldom_kernels_are_compiled_by_another_process_and_loaded_here_one_at_a_time(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    mapping_config()
    cache_without(COLD, tmp_path)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    jobs = [job for job in jobs_of_process(back_end_elsewhere=True)[1] if job.name in COLD]
    loaded: list[Job] = []
    do = Job.do
    monkeypatch.setattr(Job, "do", lambda job: (loaded.append(job), do(job)))
    seldom = SeldomKernels(jobs)
    asked = drain(seldom)
    assert loaded == jobs
    assert asked >= len(jobs)
    for name in ("build_pyramid", "write_tiles"):
        assert list(tmp_path.glob(f"**/*.{name}-*.nbc"))
    assert not list(tmp_path.glob("**/match.match_scan*.nbi"))


def test_the_process_has_the_lowest_priority():
    with worker.Worker(LAST) as process:
        assert process.stdout is not None
        process.stdout.readline()
        assert os.getpriority(os.PRIO_PROCESS, process.pid) == LAST
        process.send(None)


def test_a_process_that_died_is_logged_once(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    monkeypatch.setattr(sys, "executable", "/bin/false")
    with caplog.at_level(logging.WARNING):
        assert drain(SeldomKernels([Job("service.kernels.occupancy", "write_tiles", 0, 1)])) == 1
    assert caplog.text.count("compiled when needed") == 1
