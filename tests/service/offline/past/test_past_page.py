import json
import subprocess
import sys

import numpy as np
import pytest

from service.cli import main
from service.errors import InputError, StorageError
from service.mapstore.tiles import TileStore
from service.offline.past.moments import GO_TO
from service.offline.past.past_page import RecordingView, ShownTiles
from service.outputs import UNKNOWN
from tests.service.mapstore.tile_makers import tile
from tests.service.offline.past.past_recordings import write_past
from tests.service.recording.sessions import drive, write_file
from tests.service.web.conftest import TIMEOUT_S

ANY_PORT = "127.0.0.1:0"


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    return write_past(tmp_path_factory.mktemp("past"))


@pytest.fixture
def shown(files):
    view = RecordingView(files, ANY_PORT)
    yield view
    view.close()


@pytest.mark.parametrize(
    ("verb", "request_", "words"),
    [
        (GO_TO, {}, "position_s: Field required"),
        (GO_TO, {"position_s": -1.0}, "greater than or equal to 0"),
        (GO_TO, {"position_s": "5"}, "valid number"),
        (GO_TO, {"position_s": 1.0, "x": 1}, "Extra inputs"),
        ("reset_map", {}, "it knows moment_go_to"),
    ],
)
def test_what_cannot_be_meant_is_refused(verb, request_, words, shown, monkeypatch):
    monkeypatch.setattr(shown, "show_moment", None)
    answer = shown.answer(verb, json.dumps(request_).encode())
    assert not answer.ok
    assert words in json.loads(answer.body)["error"]


def test_a_port_that_is_taken_is_reported(shown, files, caplog):
    taken = shown.address.partition("#")[0].removeprefix("http://").rstrip("/")
    with pytest.raises(StorageError, match="--listen"):
        RecordingView(files, taken)
    assert caplog.text == ""  # reported once, by the error


def test_the_command_says_where_it_shows_until_it_is_interrupted(files):
    command = [sys.executable, "-m", "service", "view", "--json", *map(str, files), "--listen", ANY_PORT]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        printed = json.loads(process.stdout.readline())
        assert printed["address"].startswith("http://127.0.0.1:")
        process.send_signal(2)
        assert process.wait(TIMEOUT_S) == 0


@pytest.mark.parametrize("name", ["v.mcap.active", "v.mcap.damaged"])
def test_a_recording_that_was_never_finished_is_sent_to_recover(name, tmp_path, capsys):
    write_file(tmp_path / "v.mcap", drive(3))
    (tmp_path / name).write_bytes((tmp_path / "v.mcap").read_bytes()[:-100])
    assert main(["view", str(tmp_path / name)]) == InputError.exit_code
    assert f"{name} was never finished; make it whole with `corridor recover" in capsys.readouterr().err


def test_only_what_differs_gets_a_new_version_and_what_is_gone_becomes_unknown():
    store = TileStore()
    shown, first, second = ShownTiles(store), tile(0, 0, 7, value=3), tile(1, 0, 9, value=4)
    shown.take([first, second])
    assert [t.version for t in store.since(0)] == [1, 2]
    coarse = tile(1, 0, 1, value=5, level=1)
    shown.take([tile(0, 0, 1, value=3), tile(1, 0, 1, value=90), coarse])
    assert [(t.ix, t.level, t.version, int(t.cells[0, 0])) for t in store.since(2)] == [
        (1, 0, 3, 90),
        (1, 1, 4, 5),
    ]
    shown.take([tile(1, 0, 2, value=90), coarse])
    (gone,) = store.since(4)
    assert gone.ix == 0
    assert (gone.cells == UNKNOWN).all()
    shown.take([first, tile(1, 0, 2, value=90), coarse])
    (back,) = store.since(5)
    np.testing.assert_array_equal(back.cells, first.cells)
