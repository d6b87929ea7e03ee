"""A disk that is full, or that fails, under a recorder that goes on."""

import errno
import io
import logging
from pathlib import Path

from service.recording import mcap_recorder
from service.recording.mcap_file import create_stream
from service.recording.mcap_recovery import recover
from tests.service.recording.sessions import PLENTY, read_back, scan_message
from tests.set_clock import SetClock
from tests.waiting import wait_until


def test_recording_pauses_on_a_full_disk_and_resumes(recorder, caplog):
    clock, free = SetClock(), [PLENTY]
    session = recorder(keep_free_bytes=1_000_000, free_bytes_of=lambda _: free[0], monotonic_s=clock)
    session.put(scan_message(0))
    wait_until(lambda: session.health.messages == 1)
    free[0] = 999_999
    clock.now_s += 1.0
    wait_until(lambda: len(session.health.finished) == 1)
    assert session.health.state == "disk full"
    session.put(scan_message(1))
    wait_until(lambda: session.health.dropped["front/scan"] == 1)
    free[0] = 1_000_001  # enough, but so little more that it would stop again at once
    clock.now_s += 1.0
    session.put(scan_message(2))
    wait_until(lambda: session.health.dropped["front/scan"] == 2)
    free[0] = PLENTY
    clock.now_s += 1.0
    session.put(scan_message(3))
    wait_until(lambda: session.health.messages == 2)
    assert session.health.state == "recording"
    first, second = session.finish()
    assert len(read_back(first)) == len(read_back(second)) == 1
    assert "less than the 0.00 GB of recording.keep_free_gb; make room" in caplog.text


class FailingStream(io.FileIO):
    """A disk that is full after some bytes, as the kernel says it."""

    def __init__(self, path: Path, room: int) -> None:
        super().__init__(path, "xb")
        self.room = room

    def write(self, data) -> int:
        if self.tell() + len(data) > self.room:
            raise OSError(errno.ENOSPC, "No space left on device")
        return super().write(data)


def test_a_disk_error_costs_the_file_but_not_the_recording(recorder, tmp_path):
    clock = SetClock()
    rooms = iter([2_000])

    def open_stream(path: Path):
        room = next(rooms, None)
        return create_stream(path) if room is None else FailingStream(path, room)

    session = recorder(open_stream=open_stream, monotonic_s=clock)
    session.put(scan_message(0))
    wait_until(lambda: session.health.state == "disk error")  # a new file is synced with its first batch
    assert "No space left on device" in session.health.last_error
    wait_until(lambda: session.health.messages == 0)  # it is not on the disk, and counted so
    assert session.health.dropped == {"front/scan": 1}
    session.put(scan_message(1))
    wait_until(lambda: session.health.dropped["front/scan"] == 2)
    clock.now_s += mcap_recorder.RETRY_S
    session.put(scan_message(2))
    wait_until(lambda: session.health.state == "recording")
    (path,) = session.finish()
    assert (session.unfinished, session.health.state) == ([], "finished")
    assert session.health.messages == 1
    assert list(tmp_path.iterdir()) == [path]  # a disk that stays full does not gather empty files
    assert path.name.endswith("_0002.mcap")
    assert [payload for _, _, payload in read_back(path)] == [scan_message(2).payload]


def test_a_disk_that_stays_full_is_reported_once_and_when_it_takes_something_again(recorder, caplog):
    caplog.set_level(logging.INFO)
    clock = SetClock()
    rooms = iter([2_000] * 5)

    def open_stream(path: Path):
        room = next(rooms, None)
        return create_stream(path) if room is None else FailingStream(path, room)

    session = recorder(open_stream=open_stream, monotonic_s=clock)
    for number in range(5):
        session.put(scan_message(number))
        wait_until(lambda number=number: session.health.dropped["front/scan"] == number + 1)
        clock.now_s += mcap_recorder.RETRY_S
    session.put(scan_message(5))
    wait_until(lambda: "recording again, to" in caplog.text)
    assert caplog.text.count("No space left on device") == 1
    assert caplog.text.count("recording to") == 1
    session.finish()


def test_what_was_synced_before_a_disk_error_stays_to_be_recovered(recorder, tmp_path):
    clock = SetClock()
    streams: list[FailingStream] = []

    def open_stream(path: Path):
        streams.append(FailingStream(path, PLENTY))
        return streams[-1]

    session = recorder(open_stream=open_stream, monotonic_s=clock)
    session.put(scan_message(0))  # a new file is synced with its first message
    wait_until(lambda: session.health.messages == 1)
    wait_until(lambda: streams[0].tell() > 1_000)
    session.put(scan_message(1))
    session.put(scan_message(2))
    wait_until(lambda: session.health.messages == 3)
    streams[0].room = 0
    clock.now_s += 1.0
    wait_until(lambda: session.health.state == "disk error")
    wait_until(lambda: session.health.messages == 1)
    assert session.health.dropped == {"front/scan": 2}
    assert session.finish() == []
    (path,) = tmp_path.iterdir()
    assert session.unfinished == [path]
    assert session.health.state == "disk error"
    assert recover(path).messages == 1
