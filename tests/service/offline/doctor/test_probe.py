import threading

import pytest

from service.offline.doctor.probe import KEPT_BYTES, Probe, listen
from tests.drivers.scripted import ScriptedTransport

MS = 1_000_000


def test_a_stall_at_the_end_lowers_the_rate():
    arrivals_ns = [number * 20 * MS for number in range(51)]
    seen = Probe(stamps_ns=arrivals_ns, arrivals_ns=arrivals_ns, ended_ns=1_010 * MS)
    assert seen.arrival_rate_hz == pytest.approx(50.0)
    seen.ended_ns = 3_000 * MS
    assert seen.arrival_rate_hz == pytest.approx(50.0 / 3.0)
    assert Probe(stamps_ns=[0, 20], arrivals_ns=[0, 20], ended_ns=3_000 * MS).arrival_rate_hz is None


def test_listening_writes_nothing_and_keeps_no_more_than_it_needs():
    transport = ScriptedTransport([bytes(1000)] * 100)
    assert listen(lambda: transport, 60.0, threading.Event()) == bytes(KEPT_BYTES)
    assert transport.written == b""
    assert listen(lambda: ScriptedTransport([b"x"]), 60.0, threading.Event()) == b"x"
