"""The one loop: what it does with bytes, errors and time."""

import threading
from collections import Counter

import numpy as np
import pytest

from drivers import link
from drivers.clock import UNKNOWN_NS
from drivers.errors import DeviceError, ProtocolError, TransportError
from drivers.frames import NO_INTENSITY, LaserScan
from drivers.link import LinkHealth, run_link
from tests.drivers.scripted import ScriptedTransport


def scan():
    empty = np.empty(0, np.float32)
    return LaserScan("front", 0, 0, 0, 0, 0.0, 0.1, 0.0, 1.0, empty, NO_INTENSITY)


class EchoSession:
    """A frame for every chunk; says hello at its first tick and goodbye at its end."""

    def __init__(self, fails_with=None, fails_in_tick=None):
        self.outbox = bytearray()
        self.counters = Counter()
        self.status = "new"
        self.identity = {"firmware": "1"}
        self.clock_offset_ns = 7
        self.clock_sigma_ns = None
        self.ticks = 0
        self._fails_with, self._fails_in_tick = fails_with, fails_in_tick

    def receive_data(self, data, arrived_ns):
        self.status = "streaming"
        self.counters["chunks"] += 1
        if self._fails_with is not None and self.counters["chunks"] == 2:
            raise self._fails_with
        return [scan()]

    def tick(self, now_ns):
        self.ticks += 1
        if self.ticks == 1:
            self.outbox += b"hello"
        if self._fails_in_tick is not None:
            raise self._fails_in_tick

    def shutdown_request(self):
        return b"bye"


class StoppableTransport(ScriptedTransport):
    """Sets the stop event when its script has ended instead of failing."""

    def __init__(self, chunks, stop):
        super().__init__(chunks)
        self._stop = stop

    def read(self, timeout_s):
        if not self._chunks:
            self._stop.set()
            return b""
        return super().read(timeout_s)


@pytest.fixture
def quick_retries(monkeypatch):
    monkeypatch.setattr(link, "FIRST_RETRY_S", 0.0)
    monkeypatch.setattr(link, "DEVICE_ERROR_RETRY_S", 0.0)


def run(transports, sessions, stop, tee=None):
    """Run until the transports are used up; the last must set `stop`."""
    health, frames = LinkHealth("front"), []
    transports, sessions = iter(transports), iter(sessions)

    def open_transport():
        transport = next(transports)
        if isinstance(transport, Exception):
            raise transport
        return transport

    run_link(health, open_transport, lambda: next(sessions), frames.append, stop, tee)
    return health, frames


def test_outbox_is_written_frames_reach_the_sink_and_the_end_is_polite():
    stop, teed = threading.Event(), []
    wire = StoppableTransport([b"a", b"", b"b"], stop)
    health, frames = run([wire], [EchoSession()], stop, teed.append)
    assert bytes(wire.written) == b"hellobye"
    assert wire.closed
    assert len(frames) == health.frames == 2
    assert [(chunk.kind, chunk.data) for chunk in teed] == [
        ("connected", b""), ("sent", b"hello"), ("received", b"a"), ("waited", b""), ("received", b"b"),
        ("waited", b""),
    ]  # fmt: skip
    assert [chunk.at_ns for chunk in teed] == sorted(chunk.at_ns for chunk in teed)
    assert health.bytes_read == 2
    assert health.state == "streaming"
    assert (health.status, health.identity, health.clock_offset_ns) == ("streaming", {"firmware": "1"}, 7)
    assert health.last_frame_ns > 0
    assert health.delay_ns == health.last_frame_ns - frames[-1].stamp_ns


def test_a_session_is_ticked_at_the_very_time_of_what_happened_before():
    stop, teed, ticked_ns = threading.Event(), [], []
    session = EchoSession()
    tick = session.tick
    session.tick = lambda now_ns: (ticked_ns.append(now_ns), tick(now_ns))
    run([StoppableTransport([b"a", b"", b"b"], stop)], [session], stop, teed.append)
    assert ticked_ns == [chunk.at_ns for chunk in teed if chunk.kind != "sent"][:-1]  # then it was stopped
    assert len(set(ticked_ns)) == len(ticked_ns) == 4


@pytest.mark.parametrize("error", [TransportError("cut"), ProtocolError("noise"), DeviceError("refused")])
def test_every_kind_of_driver_error_is_followed_by_a_new_connection_with_a_new_session(error, quick_retries):
    stop = threading.Event()
    broken = ScriptedTransport([b"a", b"b", b"c"])
    sessions, teed = [EchoSession(fails_with=error), EchoSession()], []
    health, frames = run([broken, StoppableTransport([b"d"], stop)], sessions, stop, teed.append)
    assert broken.closed
    assert len(frames) == 2
    assert health.connects == 2
    assert health.counters["chunks"] == 3  # summed over both sessions
    assert [chunk.kind for chunk in teed] == [
        "connected", "sent", "received", "received", "connected", "sent", "received", "waited",
    ]  # fmt: skip
    assert str(error) in health.last_error


def test_an_exception_that_a_driver_did_not_mean_is_the_fault_of_this_sensor_alone(quick_retries, caplog):
    stop = threading.Event()
    faults = [OverflowError("int too large"), OverflowError("int too large")]
    transports = [ValueError("no such port"), *(ScriptedTransport([b"a"]) for _ in faults)]
    transports.append(StoppableTransport([b"d"], stop))
    sessions = [*(EchoSession(fails_in_tick=fault) for fault in faults), EchoSession()]
    health, frames = run(transports, sessions, stop)
    assert len(frames) == 1
    assert health.counters == {"chunks": 1, "driver_faults": 3}
    assert health.last_error.startswith("the driver failed: OverflowError: int too large; this is a mistake")
    errors = [record for record in caplog.records if record.levelname == "ERROR"]
    assert [record.exc_info[0] for record in errors] == [ValueError, OverflowError]  # each kind once


@pytest.mark.parametrize("taker", ["sink", "tee"])
def test_what_the_takers_of_frames_and_bytes_raise_is_no_fault_of_the_driver(taker):
    def fails(_):
        raise OSError("the disk is full")

    takers = {"sink": lambda frame: None, "tee": None} | {taker: fails}
    open_transport, stop = (lambda: ScriptedTransport([b"a"])), threading.Event()
    with pytest.raises(OSError, match="the disk is full"):
        run_link(LinkHealth("front"), open_transport, EchoSession, stop=stop, **takers)


def test_counters_are_summed_while_the_second_connection_still_runs(quick_retries):
    stop, seen = threading.Event(), []
    broken = ScriptedTransport([b"a", b"x"])
    health = LinkHealth("front")
    wires = iter([broken, StoppableTransport([b"b", b"c"], stop)])
    run_link(
        health, lambda: next(wires), EchoSession, lambda frame: seen.append(health.counters["chunks"]), stop
    )
    assert seen == [0, 1, 2, 3]


def test_refused_connection_and_failing_timer_are_retried_too(quick_retries):
    stop = threading.Event()
    transports = [TransportError("refused"), ScriptedTransport([b"a"]), StoppableTransport([b"d"], stop)]
    sessions = [EchoSession(fails_in_tick=TransportError("silent")), EchoSession()]
    health, frames = run(transports, sessions, stop)
    assert len(frames) == 1
    assert health.connects == 2
    assert "silent" in health.last_error


def test_waits_grow_from_retry_to_retry_and_are_logged_once(caplog):
    waits = []

    class ImpatientEvent(threading.Event):
        def wait(self, timeout=None):
            waits.append(timeout)
            if len(waits) == 7:
                self.set()
            return self.is_set()

    errors = [TransportError(f"{number * 12} bytes but no frame") for number in range(7)]
    health, _ = run(errors, [], ImpatientEvent())
    assert waits == [0.25, *[0.5] * 6]
    warnings = [record for record in caplog.records if record.levelname == "WARNING"]
    assert [record.getMessage() for record in warnings] == [
        "front: 0 bytes but no frame; reconnecting in 0.25 s"
    ]
    assert health.last_error == "72 bytes but no frame; reconnecting in 0.5 s"


def test_errors_that_alternate_are_logged_once_each(quick_retries, caplog):
    """Of a cable that is out, connecting fails by time-out and by "no route to host" in turn."""
    stop = threading.Event()
    turns = [TransportError(words) for words in ("timed out", "no route") * 3]
    run([*turns, StoppableTransport([b"d"], stop)], [EchoSession()], stop)
    warned = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert [text.partition(";")[0] for text in warned] == ["front: timed out", "front: no route"]


def test_each_loss_of_a_link_that_worked_is_logged_though_the_error_is_the_same(quick_retries, caplog):
    stop, gone = threading.Event(), TransportError("closed")
    transports = [
        *(TransportError("closed"), TransportError("refused"), TransportError("refused")),
        *(ScriptedTransport([b"a", b"b"]), TransportError("closed"), ScriptedTransport([b"a", b"b"])),
        StoppableTransport([b"d"], stop),
    ]
    health, frames = run(transports, [*(EchoSession(fails_with=gone) for _ in range(2)), EchoSession()], stop)
    warned = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert [text.partition(";")[0] for text in warned] == [
        *("front: closed", "front: refused"),
        *("front: closed", "front: closed"),  # of the two that had worked, not of the retry in between
    ]
    assert len(frames) == 3
    assert health.last_error.startswith("closed")


def test_a_link_that_connects_again_does_not_tell_the_status_of_before(quick_retries):
    stop, health, facts = threading.Event(), LinkHealth("front"), []

    def open_transport():
        facts.append((health.state, health.status))
        if len(facts) == 2:
            stop.set()
            raise TransportError("no route")
        return ScriptedTransport([b"a"])  # then its script has ended, which fails

    run_link(health, open_transport, EchoSession, lambda frame: None, stop)
    assert facts == [("connecting", ""), ("connecting", "")]


def test_status_follows_the_session_while_the_wire_is_silent():
    stop = threading.Event()
    session = EchoSession()
    session.status = "logging in"
    health, _ = run([StoppableTransport([b""], stop)], [session], stop)
    assert health.status == "logging in"
    assert health.state == "starting"


def test_wire_that_breaks_during_the_shutdown_request_ends_the_link_quietly():
    stop = threading.Event()

    class Breaks(StoppableTransport):
        def write(self, data):
            if data == b"bye":
                raise TransportError("gone")

    health, _ = run([Breaks([b"a"], stop)], [EchoSession()], stop)
    assert health.last_error == ""


def test_the_first_frames_wait_until_the_devices_clock_is_known():
    stop, session = threading.Event(), EchoSession()
    sigmas_ns = iter([UNKNOWN_NS, 20_000_000, 2_000_000, 20_000_000])
    receive = session.receive_data

    def receive_data(data, arrived_ns):
        session.clock_sigma_ns = next(sigmas_ns)
        return receive(data, arrived_ns)

    session.receive_data = receive_data
    health, frames = run([StoppableTransport([b"a", b"b", b"c", b"d"], stop)], [session], stop)
    assert len(frames) == 2  # the third, and the fourth: once known, it is not asked again
    assert (health.frames, health.counters["frames_before_clock"]) == (4, 2)
    assert health.clock_sigma_ns == 20_000_000


def test_a_clock_that_stays_unknown_holds_frames_back_for_two_seconds_only():
    gate = link.ClockGate()
    assert not gate.lets_through(30_000_000, 5)
    assert not gate.lets_through(30_000_000, 5 + link.CLOCK_PATIENCE_NS)
    assert gate.lets_through(30_000_000, 6 + link.CLOCK_PATIENCE_NS)
