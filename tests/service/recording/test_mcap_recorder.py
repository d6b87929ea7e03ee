import io
import logging
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from rosbags.highlevel import AnyReader

from service.encoding import STRING, Message, encode_event
from service.errors import StorageError
from service.recording import mcap_recorder
from service.recording.mcap_reader import Recording
from service.recording.mcap_recorder import McapRecorder
from service.recording.mcap_recovery import recover
from service.recording.session_change import SessionChange
from tests.service.recording.sessions import (
    PLENTY,
    T0_NS,
    as_read,
    drive,
    mountings_message,
    read_back,
    scan_message,
    write_file,
)
from tests.waiting import wait_until


def test_what_was_put_is_what_rosbags_reads(recorder, tmp_path):
    messages = drive(100)
    session = recorder(metadata={"config": {"vehicle": "veh1"}, "version": {"corridor": "0.1.0"}})
    for message in messages:
        session.put(message)
    (path,) = session.finish()
    assert path.name == "veh1_20251121T100000Z_0001.mcap"
    assert read_back(path) == as_read(messages)
    assert list(tmp_path.iterdir()) == [path]
    assert session.health.messages == len(messages)
    assert not session.health.dropped
    assert session.health.state == "finished"
    with AnyReader([path]) as reader:
        stamps = [
            reader.deserialize(raw, c.msgtype).header.stamp
            for c, _, raw in reader.messages([c for c in reader.connections if c.topic == "/front/scan"])
        ]
        (latched,) = [c for c in reader.connections if c.topic == "/tf_static"]
        (volatile,) = [c for c in reader.connections if c.topic == "/front/scan"]
    assert stamps[1].sec * 10**9 + stamps[1].nanosec == T0_NS + 20_000_000
    assert latched.ext.offered_qos_profiles[0].durability.name == "TRANSIENT_LOCAL"
    assert volatile.ext.offered_qos_profiles[0].durability.name == "VOLATILE"
    recording = Recording([path])
    assert recording.metadata == {"config": {"vehicle": "veh1"}, "version": {"corridor": "0.1.0"}}
    assert recording.library == "corridor 0.1.0"


def test_a_log_time_that_steps_back_is_written_as_it_is_and_counted(recorder):
    session = recorder()
    for index in (0, 2, 1):
        session.put(scan_message(index))
    (path,) = session.finish()
    assert session.health.steps_back == 1
    assert [log_ns for _, log_ns, _ in read_back(path)] == sorted(scan_message(i).log_ns for i in range(3))


def test_each_rotated_file_is_complete_by_itself(recorder):
    session = recorder(rotate_s=1.0, metadata={"config": {"vehicle": "veh1"}})
    messages = drive(120)
    for message in messages[:60]:
        session.put(message)
    wait_until(lambda: session.health.messages == 60)
    session.put_metadata("clock_step", {"step_ns": "17"})
    for message in messages[60:]:
        session.put(message)
    paths = session.finish()
    assert [path.name[-9:] for path in paths] == ["0001.mcap", "0002.mcap", "0003.mcap"]
    for path in paths:
        with AnyReader([path]) as reader:
            assert reader.duration <= 1.0e9
            first_topic, first_ns, _ = read_back(path)[0]
            assert first_topic == "/tf_static"
            assert first_ns == reader.start_time
        metadata = Recording([path]).metadata
        assert metadata["config"] == {"vehicle": "veh1"}
    assert "clock_step" in Recording(paths[-1:]).metadata
    together = [m.payload for m in Recording(paths).messages(["/front/scan", "/base/odom"])]
    assert together == [payload for topic, _, payload in as_read(messages) if topic != "/tf_static"]


class StuckStream(io.BytesIO):
    """Nothing, as a stream: any write waits until the disk is let go."""

    def __init__(self, path: Path, entered: threading.Event, released: threading.Event) -> None:
        super().__init__()
        self._file = path.open("xb")
        self._entered, self._released = entered, released

    def fileno(self) -> int:
        return self._file.fileno()

    def write(self, data) -> int:
        self._entered.set()
        assert self._released.wait(60.0)
        return self._file.write(data)

    def flush(self) -> None:
        self._file.flush()

    def tell(self) -> int:
        return self._file.tell()

    def close(self) -> None:
        self._file.close()


def test_put_never_waits_and_counts_what_a_stuck_disk_costs(recorder, monkeypatch, caplog):
    monkeypatch.setattr(mcap_recorder, "QUEUE_MESSAGES", 10)
    entered, released = threading.Event(), threading.Event()
    session = recorder(open_stream=lambda path: StuckStream(path, entered, released))
    try:
        session.put(scan_message(0))
        assert entered.wait(10.0)
        with caplog.at_level(logging.WARNING):
            for index in range(1, 31):
                session.put(scan_message(index))
    finally:
        released.set()
    (path,) = session.finish()
    assert session.health.dropped["front/scan"] == 20
    assert len(read_back(path)) == 11
    assert [r.message for r in caplog.records if r.levelno >= logging.WARNING] == [
        "recording drops front/scan: 10 messages wait; the disk does not keep up"
    ]


class Changes:
    """What the recorder's thread says of begun and ended sessions."""

    def __init__(self) -> None:
        self._came = threading.Semaphore(0)
        self._heard: list[SessionChange] = []

    def __call__(self, change: SessionChange) -> None:
        self._heard.append(change)
        self._came.release()

    def next(self) -> SessionChange:
        assert self._came.acquire(timeout=10.0)
        return self._heard.pop(0)


@pytest.fixture
def changes() -> Changes:
    return Changes()


def event(text: str, log_ns: int) -> Message:
    return encode_event(text, log_ns, log_ns)


def test_a_session_ends_and_another_begins_where_it_was_asked_for(recorder, changes):
    session = recorder(metadata={"config": {"vehicle": "veh1"}})
    session.put(mountings_message())
    for index in range(5):
        session.put(scan_message(index))
    session.end_session(changes)
    ended = changes.next()
    (first,) = ended.files
    assert (ended.changed, ended.error) == (True, "")
    assert session.health.state == "stopped"
    assert [topic for topic, _, _ in read_back(first)] == ["/tf_static", *["/front/scan"] * 5]
    for index in range(5, 10):
        session.put(scan_message(index))
    session.put_metadata("clock", {"step_ns": "3"})
    session.begin_session(event("go", scan_message(9).log_ns + 1), changes)
    session.put(scan_message(10))
    begun = changes.next()
    assert (begun.changed, begun.error) == (True, "")
    assert begun.files[0].name.endswith(".mcap.active")
    assert session.finish() == [first, begun.files[0].with_suffix("")]
    second = begun.files[0].with_suffix("")
    assert second.name == "veh1_20251121T100001Z_0001.mcap"  # it began within the same second
    assert [topic for topic, _, _ in read_back(second)] == ["/tf_static", "/events", "/front/scan"]
    assert Recording([second]).metadata == {"config": {"vehicle": "veh1"}, "clock": {"step_ns": "3"}}
    assert not session.health.dropped


def test_what_is_so_already_is_reported(recorder, changes):
    session = recorder()
    session.put(scan_message(0))
    session.begin_session(event("go", T0_NS + 1), changes)
    begun = changes.next()
    assert (begun.changed, len(begun.files), begun.error) == (False, 1, "")
    session.end_session(changes)
    files = changes.next().files
    assert [topic for topic, _, _ in read_back(files[0])] == ["/events", "/front/scan"]
    session.end_session(changes)
    assert changes.next() == SessionChange(False, files, "")
    assert session.finish() == files
    session.end_session(changes)
    assert changes.next() == SessionChange(False, [], "the recorder is being stopped")


def test_a_full_disk_is_reported_to_who_wants_to_record(recorder, changes):
    free = [PLENTY]
    session = recorder(keep_free_bytes=1_000_000, free_bytes_of=lambda _: free[0])
    session.end_session(changes)
    changes.next()
    free[0] = 999_999
    session.begin_session(scan_message(0), changes)
    refused = changes.next()
    assert (refused.changed, refused.files) == (True, [])
    assert "make room to record again" in refused.error


def test_bytes_as_they_came_leave_half_the_queue_to_frames(recorder, monkeypatch):
    monkeypatch.setattr(mcap_recorder, "QUEUE_MESSAGES", 10)
    entered, released = threading.Event(), threading.Event()
    session = recorder(open_stream=lambda path: StuckStream(path, entered, released))
    raw = Message("front/raw", STRING, T0_NS, T0_NS, event("", 1).payload)
    try:
        session.put(scan_message(0))
        assert entered.wait(10.0)
        for _ in range(8):
            session.put(raw)
        for index in range(1, 7):
            session.put(scan_message(index))
    finally:
        released.set()
    session.finish()
    assert session.health.dropped == {"front/raw": 3, "front/scan": 1}
    assert session.health.steps_back == 0  # raw bytes lie before the frames, as their log times do


def test_a_directory_that_cannot_be_is_refused(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(StorageError, match=r"cannot record to .*file/sessions: Not a directory"):
        McapRecorder(tmp_path / "file" / "sessions", "veh1").start()


def test_leftovers_are_recovered_while_recording_goes_on(recorder, tmp_path):
    before = tmp_path / "veh1_20251120T100000Z_0007.mcap"
    lost = write_file(before, drive(60), finish=False)
    (tmp_path / "veh1_20251119T100000Z_0001.mcap.active").write_bytes(b"\x89MCAP0\r\n")
    session = recorder()
    session.put(scan_message(0))
    wait_until(lambda: not session.recovering, 60.0)
    session.finish()
    assert read_back(before) == as_read(lost)[:100]  # the rest was never synced
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "veh1_20251119T100000Z_0001.mcap.unreadable",
        "veh1_20251120T100000Z_0007.mcap",
        "veh1_20251121T100000Z_0001.mcap",
    ]


WRITER = """
import sys, threading
from pathlib import Path
from service.recording.mcap_recorder import McapRecorder
from tests.service.recording.sessions import scan_message, mountings_message
recorder = McapRecorder(Path(sys.argv[1]), "veh1", keep_free_bytes=0)
recorder.start()
recorder.put(mountings_message())
pace = threading.Event()
for index in range(3000):
    recorder.put(scan_message(index))
    print(index, flush=True)
    pace.wait(0.02)
"""


def test_a_kill_costs_what_came_since_the_last_sync(tmp_path):
    root = Path(__file__).parents[3]
    with subprocess.Popen(
        [sys.executable, "-c", WRITER, str(tmp_path)], stdout=subprocess.PIPE, text=True, cwd=root
    ) as writer:
        try:
            last_put = 0
            for line in writer.stdout:
                last_put = int(line)
                if last_put >= 250:
                    break
        finally:
            writer.send_signal(signal.SIGKILL)
    (active,) = tmp_path.glob("*.active")
    report = recover(active)
    scans = [row for row in read_back(report.path) if row[0] == "/front/scan"]
    assert [payload for _, _, payload in scans] == [scan_message(i).payload for i in range(len(scans))]
    missing_s = (last_put + 1 - len(scans)) * 0.02
    assert missing_s < 4.0  # a second, and as long as a busy disk takes; 5 s where nothing was synced
    assert not active.exists()


def test_nothing_put_leaves_nothing_on_the_disk(recorder, tmp_path):
    session = recorder()
    assert session.finish() == []
    assert list(tmp_path.iterdir()) == []
    session.put(mountings_message())  # too late, and harmless
    assert not session.health.dropped
