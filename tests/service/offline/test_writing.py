import os
from pathlib import Path

import pytest

from service.cli import main
from service.errors import StorageError
from service.offline.calibrate import calibrate as calibrate_module
from service.offline.replay import replay as replay_module
from service.offline.writing import complete_files, refuse_unwritable_file, refuse_unwritable_folder
from tests.in_background import started


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


def test_nothing_is_put_beside_a_pipe(tmp_path: Path):
    pipe, link = tmp_path / "pipe.png", tmp_path / "link.png"
    os.mkfifo(pipe)
    link.symlink_to("target.png")
    reader = started(pipe.read_bytes)
    for out in (pipe, link):
        with complete_files(out) as path:
            path.write_bytes(b"picture")
            path.with_suffix(".pgw").write_bytes(b"world file")
    assert reader.result(10.0) == (tmp_path / "target.png").read_bytes() == b"picture"
    assert {path.name for path in tmp_path.iterdir()} == {"pipe.png", "link.png", "target.png", "link.pgw"}


def test_stdout_is_a_stream_wherever_the_shell_sends_it(tmp_path: Path):
    with (
        (tmp_path / "out").open("w") as stdout,
        complete_files(Path(f"/proc/self/fd/{stdout.fileno()}")) as path,
    ):
        path.write_text("picture")
        assert path.parent != Path("/proc/self/fd")
    assert (tmp_path / "out").read_text() == "picture"
