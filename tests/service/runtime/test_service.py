"""The service in this process: what ends it, and what it leaves behind. Its devices answer nothing."""

import gc
import os
import re
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from service.config import ServiceConfig, parse_config
from service.deadline import Deadline
from service.encoding import ERROR, OK, Message, Status, decode_diagnostics
from service.errors import CorridorError, InputError, StorageError
from service.mapstore.begin_in import MapVersion, recorded_version
from service.mapstore.files import load_map, save_map, version_folder
from service.outputs import TileUpdate
from service.publishing.commands import Answer
from service.recording.mcap_file import McapFile
from service.recording.mcap_reader import Recording
from service.runtime import service as service_module
from service.runtime.commands import Commands
from service.runtime.early_mapper import EarlyMapper
from service.runtime.health import HealthReport
from service.runtime.mapper_link import MAX_DEATHS, MapperLink
from service.runtime.notify import Notifier
from service.runtime.readers import Readers
from service.runtime.service import Service
from service.sinks.map_saver import MapSaver
from service.sinks.registry import SinkKind
from service.sinks.sink import Sink, SinkContext
from tests.in_background import started
from tests.service.mapstore.tile_makers import graph_of
from tests.service.recording.sessions import events_of
from tests.service.runtime.mappers import FATAL_RANGE_M, LOADED
from tests.service.runtime.mapping_runs import scan
from tests.waiting import wait_until

pytestmark = pytest.mark.usefixtures("forked_mappers")


@pytest.fixture
def silent_laser() -> Iterator[int]:
    """Port of a laser that takes connections and says nothing."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield server.getsockname()[1]


@pytest.fixture
def config(tmp_path: Path, silent_laser: int) -> ServiceConfig:
    return parse_config(
        f"""
vehicle: veh1
sensors: {{front: {{type: sick_lms100, host: 127.0.0.1, port: {silent_laser}}}}}
publishing: {{listen: ["tcp/127.0.0.1:0"]}}
recording: {{directory: {tmp_path}/sessions, keep_free_gb: 0.0}}
map: {{directory: {tmp_path}/maps}}
web: {{enabled: false}}
""",
        "test",
    )


class Words(Notifier):
    """Keeps what systemd would hear."""

    def __init__(self, watchdog_s: float | None = None) -> None:
        super().__init__({})
        self.watchdog_s = watchdog_s
        self.words: list[str] = []

    def send(self, line: str) -> None:
        self.words.append(line)


@pytest.fixture
def open_service(config: ServiceConfig) -> Iterator[Callable[..., Service]]:
    """Builds services, and stops them where the test has not."""
    opened: list[Service] = []

    def open_one(**settings: object) -> Service:
        settings.setdefault("notifier", Words())
        opened.append(Service(_with_map(config, settings.pop("changes", {})), **settings))  # type: ignore[arg-type]
        return opened[-1]

    yield open_one
    for service in opened:
        if not service.stopped:
            service.stop()
    gc.freeze()  # as in tests/conftest.py; the end of a service thaws all objects of the process


def _with_map(config: ServiceConfig, changes: Any) -> ServiceConfig:
    """The same with other settings in its section "map"."""
    section = config.sinks["map"].model_copy(update=changes)
    return replace(config, sinks={**config.sinks, "map": section}, begin_in=section.load)


def tick_until(service: Service, what: Callable[[], bool]) -> None:
    pause = threading.Event()
    deadline_s = time.monotonic() + 60.0
    while not what():
        assert time.monotonic() < deadline_s, "it did not come about"
        service.tick()
        pause.wait(0.02)


def feed(service: Service, scans: int, first_range_m: float = 2.0) -> None:
    """None of them is ever too old, however slow this machine is."""
    arrived_ns = time.monotonic_ns() + 3600 * 10**9
    for at_ns in range(arrived_ns, arrived_ns + scans * 20_000_000, 20_000_000):
        service.frame_sink(scan(at_ns, at_ns, [first_range_m, *[2.0] * 59]))


def last_health(recording: Recording) -> dict[str, Status]:
    """The rows by their names."""
    *_, last = recording.messages(["/diagnostics"])
    return {row.name: row for row in decode_diagnostics(last.payload)}


def test_nothing_mapped_is_no_error_and_leaves_no_map(open_service: Callable[..., Service], tmp_path: Path):
    service = open_service()
    assert service.start()
    service.tick()
    summary = service.stop()
    assert (summary.scans, summary.map_folder, service.failure) == (0, None, "")
    assert list((tmp_path / "maps").iterdir()) == []
    first, *_, last = events_of(*summary.sessions)
    assert first == {"event": "start"}
    assert last == {"event": "stop", "reason": "asked to"}


def test_a_recording_says_which_version_of_a_stored_map_it_began_in(
    config: ServiceConfig, open_service: Callable[..., Service], tmp_path: Path
):
    office = tmp_path / "maps" / "office"
    for version in (1, 2):
        tiles = [TileUpdate(0, 0, 0, version, 0.05, np.zeros((64, 64), np.int8))]
        save_map(office, tiles, version, graph=graph_of(4))
    service = open_service(changes={"load": office})
    assert service.start()
    save_map(office, [TileUpdate(0, 0, 0, 3, 0.05, np.zeros((64, 64), np.int8))], 3, graph=graph_of(4))
    recorded = Recording(service.stop().sessions).metadata["map"]
    assert recorded_version(recorded) == MapVersion(office, 2, load_map(office, 2).digest)
    assert "a session of veh1" in (version_folder(office, 2) / "kept").read_text()


def test_a_stored_map_that_is_not_there_is_refused_by_its_key(
    open_service: Callable[..., Service], tmp_path: Path
):
    with pytest.raises(InputError, match=r"map\.load: .*nowhere: no stored map"):
        open_service(changes={"load": tmp_path / "nowhere"})


def test_systemd_hears_ready_once_everything_runs(open_service: Callable[..., Service]):
    notifier = Words()
    service = open_service(notifier=notifier)
    service.start()
    assert notifier.words[-1] == "READY=1"
    assert any(word.startswith("EXTEND_TIMEOUT_USEC=") for word in notifier.words)
    service.tick()
    assert notifier.words[-1].startswith("STATUS=waiting for a scan, 0/1 sensors, 0.0 scans/s, ")
    service.stop()
    assert "STOPPING=1" in notifier.words


def test_the_watchdog_starves_when_no_one_listens_to_the_mapper(
    open_service: Callable[..., Service], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    hangs, release = threading.Event(), threading.Event()
    listen = MapperLink._listen

    def hang(self: MapperLink) -> None:
        if notifier.words.count("WATCHDOG=1") >= 2:
            hangs.set()
            release.wait(30.0)
        listen(self)

    monkeypatch.setattr(MapperLink, "_listen", hang)
    notifier = Words(watchdog_s=0.25)
    service = open_service(notifier=notifier)
    service.start()
    tick_until(service, hangs.is_set)
    tick_until(service, lambda: "the mapper's messages were not read" in caplog.text)
    fed = notifier.words.count("WATCHDOG=1")
    tick_until(service, lambda: caplog.text.count("were not read") >= 3)
    assert notifier.words.count("WATCHDOG=1") == fed
    release.set()


def test_a_mapper_that_fails_at_every_scan_brings_the_service_down_with_its_recording_finished(
    open_service: Callable[..., Service], strange: Callable[[str], None]
):
    strange("raises")
    facts = threading.Event()
    service = open_service(on_failure=facts.set)
    service.start()
    feed(service, MAX_DEATHS, FATAL_RANGE_M)
    assert facts.wait(30.0)
    assert f"{MAX_DEATHS} times after item 0" in service.failure
    summary = service.stop()
    recording = Recording(summary.sessions)
    assert [m.channel for m in recording.messages(["/front/scan"])] == ["front/scan"] * MAX_DEATHS
    events = events_of(*summary.sessions)
    assert sum(event["event"] == "frame_refused" for event in events) == MAX_DEATHS
    assert any(event["event"] == "mapper_restarted" and "no such tile" in str(event) for event in events)
    assert "no such tile" in events[-1]["reason"]


def test_a_mapper_that_does_not_end_in_good_order_costs_neither_recording_nor_map(
    open_service: Callable[..., Service], monkeypatch: pytest.MonkeyPatch
):
    def fail(self: MapperLink) -> None:
        clean_up(self)
        raise OSError("the disk hangs")

    clean_up = MapperLink.clean_up
    monkeypatch.setattr(MapperLink, "clean_up", fail)
    service = open_service()
    service.start()
    summary = service.stop()
    assert service.failure == "the end of the mapper: OSError: the disk hangs"
    assert "the disk hangs" in events_of(*summary.sessions)[-1]["reason"]


def test_a_sink_that_waits_for_the_mapper_at_the_end_hears_that_no_answer_comes(
    open_service: Callable[..., Service], monkeypatch: pytest.MonkeyPatch
):
    answers: list[Answer] = []

    def flush_late(self: MapSaver) -> None:
        answers.append(asking.result(5.0))
        flush(self)

    flush = MapSaver.flush
    monkeypatch.setattr(MapSaver, "flush", flush_late)
    monkeypatch.setattr(MapperLink, "finish", lambda self, deadline: False)
    service = open_service()
    service.start()
    os.kill(service.mapper_pid, signal.SIGSTOP)
    asking = started(lambda: service._command("checkpoint", b"{}"))
    wait_until(lambda: service._link.waiting)
    service.stop()
    assert b"the service is stopping" in answers[0].body


def test_what_cannot_be_reported_at_the_end_costs_neither_recording_nor_hooks(
    open_service: Callable[..., Service], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    def fail(self: HealthReport, unix_ns: int) -> Message:
        raise ValueError("a rate that is no number")

    hook = threading.excepthook
    service = open_service()
    service.start()
    monkeypatch.setattr(HealthReport, "message", fail)
    monkeypatch.setattr(Commands, "close", lambda self: [][0])
    summary = service.stop()
    assert service.failure == "the end of commands: IndexError: list index out of range"
    assert not list((tmp_path / "sessions").glob("*.active"))
    assert events_of(*summary.sessions)[-1] == {"event": "stop", "reason": service.failure}
    assert (threading.excepthook, gc.get_freeze_count()) == (hook, 0)


def test_a_clean_stop_is_no_fault_however_long_it_takes(
    open_service: Callable[..., Service], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    service = open_service()
    service.start()
    arrived_ns = time.monotonic_ns()
    link = service._report._links["front"]
    link.frames, link.last_frame_ns = 1, arrived_ns + 3600 * 10**9
    service.frame_sink(scan(link.last_frame_ns, link.last_frame_ns, [2.0] * 60))
    tick_until(service, lambda: service.outputs.states.total() == 1)
    tick_until(service, lambda: link.connects == 1)  # its thread has set the state by then
    link.state = "streaming"
    service.outputs.last_ns = link.last_frame_ns
    later = SimpleNamespace(
        monotonic=time.monotonic,
        process_time=time.process_time,
        monotonic_ns=lambda: link.last_frame_ns + 60 * 10**9,
    )

    def stop(self: Readers, deadline: Deadline) -> None:
        stop_readers(self, deadline)
        monkeypatch.setattr(service_module, "time", later)

    stop_readers = Readers.stop
    monkeypatch.setattr(Readers, "stop", stop)
    sessions = service.stop().sessions
    rows = last_health(Recording(sessions))
    assert (rows["sensor/front"].level, rows["mapping"].message) == (OK, "ok")
    assert "mapping is stale" not in caplog.text
    assert "stale" not in str(events_of(*sessions))


def test_a_thread_no_one_watches_brings_the_service_down_too(
    open_service: Callable[..., Service], monkeypatch: pytest.MonkeyPatch
):
    facts = threading.Event()
    service = open_service(on_failure=facts.set)
    service.start()
    stray = threading.Thread(target=lambda: [][0], name="stray")
    stray.start()
    assert facts.wait(5.0)
    stray.join()
    assert service.failure == "stray: IndexError: list index out of range"
    service.stop()


def test_kernels_that_do_not_compile_stop_the_start(
    open_service: Callable[..., Service], strange: Callable[[str], None]
):
    strange("does not compile")
    service = open_service()
    with pytest.raises(CorridorError, match="mapper's process ended before it was ready"):
        service.start()
    assert service.stop().sessions == []


def test_a_start_that_compiles_says_that_it_goes_on_and_can_be_called_off(
    open_service: Callable[..., Service], strange: Callable[[str], None], monkeypatch: pytest.MonkeyPatch
):
    strange("compiles for ever")
    monkeypatch.setattr(service_module, "WARM_UP_TELL_S", 0.0)
    notifier = Words()
    service = open_service(notifier=notifier)
    words = "compiling kernels: 1 of 2, "
    status = f"STATUS={words}"
    assert not service.start(cancelled=lambda: any(word.startswith(status) for word in list(notifier.words)))
    pid = service.mapper_pid
    assert service.stop().sessions == []
    if pid:
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)


def test_what_was_loaded_before_the_config_was_checked_is_not_loaded_again(
    open_service: Callable[..., Service],
    strange: Callable[[str], None],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
):
    """A second load with a cold cache compiles before READY what was left for after it."""
    strange("says what it loads")
    loaded = tmp_path / "loaded"
    monkeypatch.setenv(LOADED, str(loaded))
    for facts, times in (("corridor", 1), ("imle", 2)):
        loaded.write_text("")
        with EarlyMapper() as early:
            early.tell({"profile": facts})
            service = open_service(early=early)
            assert service.start()
            service.stop()
        assert loaded.read_text().split() == ["once"] * times


def test_a_start_that_was_called_off_while_the_sinks_opened_begins_no_mapper(
    open_service: Callable[..., Service], monkeypatch: pytest.MonkeyPatch
):
    begun: list[MapperLink] = []
    monkeypatch.setattr(MapperLink, "start", begun.append)
    service = open_service()
    assert not service.start(cancelled=lambda: True)
    assert not begun
    service.stop()


def test_a_map_that_cannot_be_saved_is_a_failure_after_everything_ended(
    open_service: Callable[..., Service], tmp_path: Path
):
    service = open_service()
    service.start()
    (tmp_path / "maps").rmdir()
    (tmp_path / "maps").write_text("in the way")
    feed(service, 40)
    assert "cannot save the map" in service.stop().failure
    sessions = sorted((tmp_path / "sessions").glob("*.mcap"))
    assert any(topic.name == "/pose" for topic in Recording(sessions).topics)


def test_a_recording_that_is_not_finished_is_a_failure_after_everything_ended(
    open_service: Callable[..., Service], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    def fail(self: McapFile) -> None:
        self.sync()
        raise OSError("File too large")

    monkeypatch.setattr(McapFile, "finish", fail)
    service = open_service()
    service.start()
    assert re.search(r"File too large.*_0001\.mcap\.active; ", service.stop().failure)
    assert len(list((tmp_path / "sessions").glob("*.mcap.active"))) == 1


@pytest.mark.parametrize(
    ("folder", "words"), [("sessions", "cannot record"), ("maps", "cannot write to .*maps")]
)
def test_a_folder_that_cannot_be_written_stops_the_start(
    folder: str, words: str, open_service: Callable[..., Service], tmp_path: Path
):
    (tmp_path / folder).write_text("in the way")
    service = open_service()
    with pytest.raises(StorageError, match=words):
        service.start()
    service.stop()
    assert list(tmp_path.glob("sessions/*.mcap*")) == []  # nothing was driven: no recording of that


def test_a_step_of_the_wall_clock_is_reported_and_not_applied(
    open_service: Callable[..., Service], monkeypatch: pytest.MonkeyPatch
):
    service = open_service()
    service.start()
    before_ns = service.host_time.offset_ns
    stepped = service_module.HostTime(before_ns + 3_600_000_000_000)
    monkeypatch.setattr(service_module.HostTime, "now", lambda: stepped)
    service.tick()
    assert service.host_time.offset_ns == before_ns
    summary = service.stop()
    assert Recording(summary.sessions).metadata["clock"]["wall_clock_step_ns"] == "3600000000000"
    assert {"event": "clock_step", "step_ns": 3_600_000_000_000} in events_of(*summary.sessions)


class BrokenSink(Sink):
    """Takes no message, and its thread dies at once."""

    name = "broken"

    def start(self) -> None:
        threading.Thread(target=lambda: [][0], name="broken-writer").start()

    def put(self, message: Message, arrived_ns: int | None = None) -> None:
        raise OSError("no paper")

    def health(self) -> Status:
        return Status(self.name, OK, "ok", {})

    def close(self) -> None:
        raise OSError("the printer hangs")


def open_broken_sink(section: object, context: SinkContext) -> BrokenSink:
    return BrokenSink()


def test_a_sink_with_every_fault_costs_neither_mapping_nor_another_sink(
    open_service: Callable[..., Service], monkeypatch: pytest.MonkeyPatch
):
    broken = SinkKind("recording", "none:none", f"{__name__}:open_broken_sink")
    monkeypatch.setattr(service_module, "SINKS", (broken, *service_module.SINKS))
    service = open_service()
    service.start()
    feed(service, 20)
    tick_until(service, lambda: service.outputs.states.total() == 20)
    service.tick()
    summary = service.stop()
    assert service.failure == ""
    recording = Recording(summary.sessions)
    assert len(list(recording.messages(["/pose"]))) == 20
    rows = last_health(recording)
    assert rows["broken"].level == ERROR
    assert int(rows["broken"].values["refused"]) > 20
    assert {name: rows[name].level for name in ("zenoh", "recording", "map")} == {
        "zenoh": OK, "recording": OK, "map": OK,
    }  # fmt: skip
    assert summary.map_folder is not None
