"""The mapper's process that is begun before the config is checked."""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from service.runtime.early_mapper import EarlyMapper, MapperSocket, mapping_section
from tests.processes import alive, look_at
from tests.waiting import wait_until


@pytest.mark.parametrize("content", [b"mapping: 3", b"- mapping", b"", b"\xff\xfe", b"vehicle: a"])
def test_a_file_without_a_section_has_an_empty_one(tmp_path: Path, content: bytes):
    path = tmp_path / "vehicle.yaml"
    path.write_bytes(content)
    assert mapping_section(path) == {}


@pytest.mark.parametrize("is_reported", [False, True])
def test_a_process_that_no_one_takes_over_ends_with_its_folder(is_reported: bool):
    with EarlyMapper() as early:
        if is_reported:
            early.tell({"profile": "corridor"})
        folder = early.mapper_socket.folder
        assert folder.exists()
        with pytest.raises(subprocess.TimeoutExpired):
            early.process.wait(0.05)
    assert early.process.returncode is not None
    assert not folder.exists()


BEGINS = """
from service.runtime.early_mapper import EarlyMapper
with EarlyMapper() as early:
    early.tell({})
    print(early.process.pid, flush=True)
    input()
"""


def test_a_service_that_is_killed_leaves_no_process_that_compiles_kernels(tmp_path: Path):
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path), "TMPDIR": str(tmp_path)}
    command, pipe = [sys.executable, "-c", BEGINS], subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True, env=environment) as service:
        mapper = int(service.stdout.readline())
        wait_until(lambda: any(one.parent == mapper for one in alive()), 120.0, "it compiles nothing")
        pids = [mapper, *(one.pid for one in alive() if one.parent == mapper)]

        def spent_s() -> list[float]:
            return [one.cpu_s for one in map(look_at, pids) if one is not None]

        before_s = sum(spent_s())
        service.kill()
        service.wait()
        wait_until(lambda: not spent_s() or sum(spent_s()) > before_s + 2.0, 60.0, "they outlive it")
        assert not spent_s()  # they have not computed on, however slow the machine is


MAKES = (
    "from service.runtime.early_mapper import MapperSocket as M; m = M(); print(m.folder, flush=1); input()"
)


def test_the_folder_of_a_service_that_was_killed_is_removed_by_the_next(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr(tempfile, "tempdir", None)  # as it is before anybody has asked
    living = MapperSocket()
    just_made = tmp_path / "corridor-mapper-new"
    just_made.mkdir()
    command = [sys.executable, "-c", MAKES]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as other:
        theirs = Path(other.stdout.readline().strip())
        while_it_lives = MapperSocket()
        assert theirs.exists()
        other.kill()
    assert theirs.exists()
    after = MapperSocket()
    assert sorted(tmp_path.iterdir()) == sorted(
        [living.folder, just_made, while_it_lives.folder, after.folder]
    )
    for socket in (living, while_it_lives, after):
        socket.close()
    assert list(tmp_path.iterdir()) == [just_made]
