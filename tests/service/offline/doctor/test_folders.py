import fcntl

import pytest

from service.config import ServiceConfig, parse_config
from service.offline.doctor import folders
from service.offline.doctor.folders import look_at_disk, look_at_folders, look_at_leftovers
from tests.service.offline.doctor.conftest import FakeTree


@pytest.fixture
def config() -> ServiceConfig:
    text = """\
vehicle: veh1
sensors: {front: {type: sick_lms100, host: 127.0.0.1}}
recording: {directory: /data/sessions, keep_free_gb: 2, rotate_mb: 1000}
map: {directory: /data/maps}
"""
    return parse_config(text, "v.yaml")


def test_a_folder_that_cannot_be_written_says_why(
    tree: FakeTree, config: ServiceConfig, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(folders, "cannot_write", lambda folder: "Read-only file system")
    sessions, maps = look_at_folders(tree.machine(), config)
    assert sessions.severity == maps.severity == "fault"
    assert sessions.measured == "user driver cannot write /data/sessions: Read-only file system"
    assert "change map.directory" in maps.remedy


@pytest.mark.parametrize(
    ("free_gb", "severity", "words"),
    [
        (1.9, "fault", "recording pauses"),
        (3.5, "note", "1.5 GB more and recording pauses"),
        (4.1, "ok", "4.1 GB free"),
    ],
)
def test_room_on_the_disk_is_measured_against_what_is_kept(
    tree: FakeTree, config: ServiceConfig, free_gb: float, severity: str, words: str
):
    finding = look_at_disk(tree.machine(free_bytes=lambda path: round(free_gb * 1e9)), config)
    assert finding.severity == severity
    assert words in finding.measured


def test_sessions_whose_writer_died_are_distinguished_from_one_that_is_written(
    tree: FakeTree, config: ServiceConfig
):
    assert look_at_leftovers(tree.machine(), config) == []
    tree.write("/data/sessions/dead.mcap.active", "")
    alive = tree.write("/data/sessions/alive.mcap.active", "")
    with alive.open("rb") as stream:
        fcntl.flock(stream, fcntl.LOCK_EX)
        (finding,) = look_at_leftovers(tree.machine(), config)
    assert finding.severity == "note"
    assert finding.measured == "1 session whose writer died: dead.mcap.active"
    assert "corridor recover" in finding.remedy
