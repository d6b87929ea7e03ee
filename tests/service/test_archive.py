"""URLs as source and sink: an S3 server and a web server on loopback."""

import asyncio
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from queue import SimpleQueue

import pytest
from aiohttp import web
from pyarrow import parquet

from service.archive import path_or_url, refuse_missing_bucket
from service.cli import main
from service.errors import InputError, StorageError, UsageError
from tests.s3_bucket import s3_bucket
from tests.service.offline.cluster.test_cluster import results_in
from tests.service.offline.conftest import record_drive
from tests.service.offline.recorded_drives import RecordDrive

__all__ = ["record_drive"]  # a fixture


@pytest.fixture(scope="module")
def bucket() -> Iterator[Path]:
    with s3_bucket() as opened:
        yield opened


def test_s3_is_source_and_sink_of_the_same_bytes(
    bucket: Path,
    record_drive: RecordDrive,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
):
    sessions = [record_drive("a", scans=10), record_drive("b", scans=12)]
    local = [str(sessions[0].parent), "--out", str(tmp_path / "out"), "--jobs", "1"]
    assert main(["replay", *local]) == 0
    for session in sessions:
        (bucket / "in" / session.name).write_bytes(session.read_bytes())
    copies = partial(pytest.fail, "a session is copied whole")
    monkeypatch.setattr("service.recording.unpacking.copy_here", copies)
    remote = ["s3://site/in", "--out", "s3://site/out", "--jobs", "1"]
    assert main(["replay", *remote]) == 0
    assert "summaries of all sessions: s3://site/out/sessions.parquet" in capfd.readouterr().err
    bucket.fs.get("site/out", str(tmp_path / "fetched"), recursive=True)  # type: ignore[attr-defined]
    here, fetched = results_in(tmp_path / "out"), results_in(tmp_path / "fetched")
    assert here.keys() == fetched.keys()
    assert [name for name in here if here[name] != fetched[name]] == [
        name for name in here if name.endswith("done.json")
    ]
    with (bucket / "out" / "sessions.parquet").open("rb") as file:
        assert [row["scans"] for row in parquet.read_table(file).to_pylist()] == [10, 12]
    assert main(["replay", *remote]) == 0
    assert "2 of 2 sessions are done already" in capfd.readouterr().err
    assert main(["replay", "s3://site/none.mcap", "--out", str(tmp_path / "none")]) == InputError.exit_code
    assert "s3://site/none.mcap: no such file or folder" in capfd.readouterr().err


def test_a_result_in_a_bucket_replaces_the_earlier_one_there_and_nothing_else(
    bucket: Path, record_drive: RecordDrive
):
    session, out = record_drive("c", scans=10), bucket / "one"
    kept, stale = out / "drives" / "c.mcap", [out / "report.html", out / "map" / "v000002" / "tiles.npz"]
    for path in (kept, *stale):
        path.write_text("of before")
    assert main(["replay", str(session), "--out", "s3://site/one"]) == 0
    assert (out / "summary.json").exists()
    assert kept.read_text() == "of before"
    assert not any(path.exists() for path in stale)


def test_a_bucket_that_is_not_there_is_refused_and_not_made(
    bucket: Path, record_drive: RecordDrive, capfd: pytest.CaptureFixture[str]
):
    out = ["--out", "s3://sight/one"]
    assert main(["replay", str(record_drive("d", scans=10)), *out]) == StorageError.exit_code
    assert "cannot write to s3://sight/one: there is no bucket sight; make it first" in capfd.readouterr().err
    assert bucket.fs.ls("/", refresh=True) == ["site"]  # type: ignore[attr-defined]


def test_a_bucket_that_may_not_be_asked_for_is_not_refused(
    bucket: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def forbidden(_: str) -> None:
        raise PermissionError("Forbidden")

    out = bucket / "one"
    monkeypatch.setattr(out.fs, "info", forbidden)  # type: ignore[attr-defined]
    refuse_missing_bucket(out)


@contextmanager
def web_server(folder: Path, sends_parts: bool) -> Iterator[str]:
    """The address of a server of the files in a folder."""

    async def whole(request: web.Request) -> web.Response:
        return web.Response(body=(folder / request.path[1:]).read_bytes())

    async def serve() -> None:
        app = web.Application()
        if sends_parts:
            app.router.add_static("/", folder)
        else:
            app.router.add_get("/{name}", whole)
        runner = web.AppRunner(app)
        await runner.setup()
        site = web.TCPSite(runner, "127.0.0.1", 0)
        await site.start()
        addresses.put("http://{}:{}".format(*runner.addresses[0]))
        await asyncio.to_thread(ended.wait)
        await runner.cleanup()

    addresses: SimpleQueue[str] = SimpleQueue()
    ended = threading.Event()
    thread = threading.Thread(target=asyncio.run, args=(serve(),))
    thread.start()
    try:
        yield addresses.get(timeout=10.0)
    finally:
        ended.set()
        thread.join()


@pytest.mark.parametrize(("sends_parts", "code"), [(True, 0), (False, InputError.exit_code)])
def test_a_recording_is_read_from_a_web_server_that_sends_parts_of_files(
    sends_parts: bool, code: int, record_drive: RecordDrive, tmp_path: Path, capfd: pytest.CaptureFixture[str]
):
    session = record_drive(scans=10)
    with web_server(session.parent, sends_parts) as address:
        assert main(["replay", f"{address}/{session.name}", "--out", str(tmp_path / "out")]) == code
    assert ("sends no parts of files (Range)" in capfd.readouterr().err) is not sends_parts


def test_file_urls_are_local_paths():
    assert path_or_url("file:///a%20b/c.mcap") == Path("/a b/c.mcap")
    assert path_or_url("drive.mcap") == Path("drive.mcap")


def test_a_url_of_no_known_kind_is_wrong_usage(capfd: pytest.CaptureFixture[str]):
    assert main(["replay", "gopher://a/b.mcap"]) == UsageError.exit_code
    assert "gopher://a/b.mcap cannot be opened" in capfd.readouterr().err


def test_a_server_that_is_not_there_is_named(capfd: pytest.CaptureFixture[str]):
    assert main(["replay", "http://127.0.0.1:9/a.mcap"]) == InputError.exit_code
    assert "http://127.0.0.1:9/a.mcap" in capfd.readouterr().err
