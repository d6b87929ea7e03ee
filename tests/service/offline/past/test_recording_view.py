import json
import subprocess
import sys

import pytest

from service.cli import main
from service.errors import InputError, StorageError
from service.offline.past.moments import GO_TO
from service.offline.past.past_page import RecordingView
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
    assert caplog.text == ""  # said once, by the error


def test_the_command_says_where_it_shows_until_it_is_interrupted(files):
    command = [sys.executable, "-m", "service", "view", "--json", *map(str, files), "--listen", ANY_PORT]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        said = json.loads(process.stdout.readline())
        assert said["address"].startswith("http://127.0.0.1:")
        process.send_signal(2)
        assert process.wait(TIMEOUT_S) == 0


@pytest.mark.parametrize("name", ["v.mcap.active", "v.mcap.damaged"])
def test_a_recording_that_was_never_finished_is_sent_to_recover(name, tmp_path, capsys):
    write_file(tmp_path / "v.mcap", drive(3))
    (tmp_path / name).write_bytes((tmp_path / "v.mcap").read_bytes()[:-100])
    assert main(["view", str(tmp_path / name)]) == InputError.exit_code
    assert f"{name} was never finished; make it whole with `corridor recover" in capsys.readouterr().err
