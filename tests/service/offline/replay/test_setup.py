"""In which version of a stored map a replay begins. Nothing is mapped here."""

import logging
import shutil
from pathlib import Path

import numpy as np
import pytest

from service.cli import main
from service.errors import UsageError
from service.mapstore.begin_in import MapVersion
from service.mapstore.files import load_map, save_map
from service.offline.replay.setup import ReplayOptions, overlay, set_up
from service.outputs import TileUpdate
from service.recording.mcap_recorder import McapRecorder
from service.recording.mcap_source import Session, open_session
from tests.service.mapstore.tile_makers import graph_of
from tests.service.recording.sessions import drive

CONFIG = """\
vehicle: v
sensors: {front: {type: sick_lms100, host: a}}
recording: {directory: s}
map: {directory: m, load: %s}
"""


def save_version(folder: Path, number: int) -> None:
    cells = np.zeros((64, 64), np.int8)
    save_map(folder, [TileUpdate(0, 0, 0, number, 0.05, cells)], number, graph=graph_of(4 * number))


@pytest.fixture
def office(tmp_path: Path) -> Path:
    """Of two versions."""
    for number in (1, 2):
        save_version(tmp_path / "office", number)
    return tmp_path / "office"


@pytest.fixture
def session(tmp_path: Path, office: Path) -> Session:
    """It began in the first version, and the second came of it."""
    begun_in = MapVersion(office, 1, load_map(office, 1).digest)
    metadata = {"config": {"yaml": CONFIG % office}, "map": begun_in.as_metadata()}
    recorder = McapRecorder(tmp_path, "v", keep_free_bytes=0, metadata=metadata)
    recorder.start()
    for message in drive(2):
        recorder.put(message)
    return open_session(recorder.finish())


def test_a_copy_of_the_map_is_the_same_map(session: Session, office: Path, tmp_path: Path):
    shutil.copytree(office, tmp_path / "elsewhere", symlinks=True)
    assert set_up(session, ReplayOptions(map=tmp_path / "elsewhere")).map_version == 1


def test_a_version_that_is_gone_is_reported(session: Session, office: Path, caplog: pytest.LogCaptureFixture):
    shutil.rmtree(office / "v000001")
    assert set_up(session, ReplayOptions(map=office)).map_version is None
    assert "version 1 of" in caplog.text
    assert "is not there any more" in caplog.text


def test_a_map_that_is_left_out_is_reported_with_the_option(
    session: Session, office: Path, caplog: pytest.LogCaptureFixture
):
    setup = set_up(session, ReplayOptions())
    assert not setup.is_as_live
    assert f"--map {office}@1 begins there" in caplog.text
    caplog.clear()
    with caplog.at_level(logging.WARNING):
        set_up(session, ReplayOptions(map=office))
    assert caplog.text == ""


def test_what_is_laid_over_a_section_leaves_its_neighbours():
    section = {"profile": "corridor", "settings": {"matcher": {"a": 1, "b": 2}}}
    overlay(section, {"cell_m": 0.1, "settings": {"matcher": {"b": 3}}})
    assert section == {"profile": "corridor", "settings": {"matcher": {"a": 1, "b": 3}}, "cell_m": 0.1}


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--localize"], "--localize is in a stored map; name it by --map"),
        (["--profile", "submap_graph", "--map", "m"], "profile submap_graph cannot begin in a stored map"),
    ],
)
def test_options_that_do_not_go_together_are_wrong_usage(
    options: list[str], words: str, capsys: pytest.CaptureFixture[str]
):
    assert main(["replay", "nowhere.mcap", *options]) == UsageError.exit_code
    assert words in capsys.readouterr().err
