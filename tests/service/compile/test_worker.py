import os
import select
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

from service.compile.cache import cache_folder
from service.compile.lazy import load_compiler
from service.compile.signatures import Job, jobs_of_process
from service.compile.worker import SeldomKernels
from service.mapper.profiles import mapping_config

WITHIN_S = 60.0
COLD = ("cell_bounds", "write_tiles", "farthest_m2")  # the last is called with every scan; all are small


def drain(seldom: SeldomKernels) -> None:
    while not seldom.is_done:
        assert select.select([seldom], [], [], WITHIN_S)[0], "nothing more comes"
        seldom.load_next()


def cache_without(kernels: Sequence[str], place: Path) -> None:
    """All kernels that this process keeps but some, in the folder of a process that keeps its own."""
    load_compiler()
    (folder := cache_folder(place)).mkdir()
    for path in cache_folder().glob("*.nb[ci]"):
        if path.name.split("-")[0].split(".")[-1] not in kernels:
            shutil.copy2(path, folder)


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
    monkeypatch.setattr("service.compile.worker.LAST", 0)  # else it waits until no other test computes
    seldom = SeldomKernels(jobs)
    seldom.load_next()
    assert loaded == []  # it has not waited
    drain(seldom)
    assert loaded == jobs
    for name in COLD[:2]:
        assert list(tmp_path.glob(f"**/*.{name}-*.nbc"))
    assert not list(tmp_path.glob("**/tiles.farthest_m2*.nbi"))


SCRIPT = """
from service.compile.worker import Worker
print("mapped")
worker = Worker()
assert worker.wait_for_line()
print(worker.pid, flush=True)
input()
"""


def test_the_process_runs_no_script_again_and_ends_with_the_process_that_began_it(tmp_path: Path):
    (tmp_path / "script.py").write_text(SCRIPT)
    command, pipe = [sys.executable, str(tmp_path / "script.py")], subprocess.PIPE
    with subprocess.Popen(command, bufsize=0, stdin=pipe, stdout=pipe) as script:
        assert script.stdout.readline() == b"mapped\n"
        worker = os.pidfd_open(int(script.stdout.readline()))
        assert not select.select([worker], [], [], 0.0)[0]
        script.kill()
    ended = select.select([worker], [], [], 10.0)[0]
    os.close(worker)
    assert ended
