import errno
import threading
from pathlib import Path

import pytest

from service.encoding import Message, decode_event, encode_event
from service.errors import StorageError
from service.recording.config import RecordingConfig
from service.recording.mcap_file import McapFile
from service.recording.mcap_reader import Recording
from service.sinks.mcap_sink import McapSink
from tests.service.sinks.contexts import sink_context

T0_NS = 1_700_000_000_000_000_000


def sink_in(folder: Path, is_paused: bool = False, **config: object) -> McapSink:
    context = sink_context(metadata={"clock": {"step": "0"}}, is_paused=lambda: is_paused)
    settings = {"directory": folder, "keep_free_gb": 0.0, **config}
    return McapSink(RecordingConfig.model_validate(settings), context)


def event(text: str, log_ns: int) -> Message:
    return encode_event(text, log_ns, log_ns)


def events(path: Path) -> list[str]:
    return [decode_event(m.payload) for m in Recording([path]).messages(["/events"])]


def test_every_channel_is_recorded_and_what_is_complete_is_reported(tmp_path: Path):
    sink = sink_in(tmp_path)
    sink.start()
    sink.put(event("a", T0_NS))
    assert sink.written() == []
    sink.put_metadata("clock", {"step": "5"})
    sink.close()
    (session,) = sink.written()
    assert events(session) == ["a"]
    assert Recording([session]).metadata["clock"] == {"step": "5"}
    assert sink.place() == str(tmp_path)


@pytest.mark.parametrize("is_paused", [False, True])
def test_a_session_that_begins_in_a_pause_says_so(tmp_path: Path, is_paused: bool):
    sink = sink_in(tmp_path, is_paused)
    sink.start()
    sink.begin_session(event("begin", T0_NS), lambda change: None)
    sink.close()
    (session,) = sink.written()
    paused = ['{"event": "pause", "reason": "paused before the recording began"}']
    assert events(session) == ["begin", *(paused if is_paused else [])]


def test_files_that_a_disk_error_left_unfinished_are_named_at_the_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    sink = sink_in(tmp_path)
    sink.start()
    sink.put(event("a", T0_NS))
    synced = threading.Event()
    sync = McapFile.sync

    def note(file: McapFile) -> None:
        sync(file)
        synced.set()

    def fail(file: McapFile) -> None:
        raise OSError(errno.EFBIG, "File too large")

    monkeypatch.setattr(McapFile, "sync", note)
    assert synced.wait(20.0)
    monkeypatch.setattr(McapFile, "finish", fail)
    sink.put(event("b", T0_NS + 1))
    with pytest.raises(StorageError, match=r"File too large; .*corridor recover FILE") as caught:
        sink.close()
    (left,) = tmp_path.glob("*.mcap.active")
    assert f"unfinished: {left}; the next start" in str(caught.value)
    assert sink.written() == []
