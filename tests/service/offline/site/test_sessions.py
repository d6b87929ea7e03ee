"""Names of the sessions of a site: one recording keeps its name, another one of that name is numbered."""

import json
from pathlib import Path

from service.archive import fingerprint
from service.mapstore.files import save_map
from service.offline.past.result import DONE_FILE
from service.offline.site.sessions import digest_of, given_sessions
from tests.service.mapstore.tile_makers import tile


def recording(folder: Path, content: bytes) -> Path:
    folder.mkdir()
    path = folder / "drive.mcap"
    path.write_bytes(content)
    return path


def test_a_recording_keeps_its_name_and_another_one_of_that_name_is_numbered(tmp_path):
    first, second = recording(tmp_path / "1", b"first"), recording(tmp_path / "2", b"second")
    replayed = tmp_path / "sessions"
    save_map(replayed / "drive" / "map", [tile(0, 0, 1)], 1)
    manifest = {"program": "an earlier one", "input": {first.name: fingerprint(first)}}
    (replayed / "drive" / DONE_FILE).write_text(json.dumps(manifest))
    digest = digest_of(replayed / "drive")
    assert digest
    given, _ = given_sessions([second, first], tmp_path, replayed, {"drive": digest})
    assert [(one.name, one.recording, one.digest) for one in given] == [
        ("drive_2", (second,), ""),
        ("drive", (first,), digest),
    ]
    assert [one.result for one in given] == [replayed / "drive_2", replayed / "drive"]


def test_a_replay_that_broke_off_is_done_again_under_its_name(tmp_path):
    path = recording(tmp_path / "1", b"first")
    (tmp_path / "sessions" / "drive").mkdir(parents=True)
    [given], _ = given_sessions([path], tmp_path, tmp_path / "sessions", {})
    assert (given.name, given.digest) == ("drive", "")
