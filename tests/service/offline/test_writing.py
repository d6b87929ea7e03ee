from pathlib import Path

import pytest

from service.cli import main
from service.errors import StorageError
from service.offline.calibrate import calibrate as calibrate_module
from service.offline.replay import replay as replay_module
from service.offline.writing import refuse_unwritable_file, refuse_unwritable_folder


def test_a_file_where_a_folder_is_needed_is_named(tmp_path: Path):
    (tmp_path / "file").touch()
    with pytest.raises(StorageError, match=r"file/x: .*file is no folder"):
        refuse_unwritable_folder(tmp_path / "file" / "x")
    with pytest.raises(StorageError, match="Is a directory"):
        refuse_unwritable_file(tmp_path)


def test_an_output_that_cannot_be_written_is_refused_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    def work(*_: object) -> None:
        raise AssertionError("begun")

    monkeypatch.setattr(replay_module, "replay", work)
    monkeypatch.setattr(calibrate_module, "calibrate", work)
    (tmp_path / "file").touch()
    session, out = tmp_path / "s.mcap", str(tmp_path / "file" / "x")
    session.touch()
    assert main(["replay", str(session), "--out", out]) == StorageError.exit_code
    assert main(["calibrate", str(session), "--out", out]) == StorageError.exit_code
    assert capsys.readouterr().err.count("file is no folder") == 2
