"""Devices whose messages come whole and are no use: the error says so instead of asking for the cable."""

import math
from typing import Any

import pytest

from drivers.errors import TransportError
from drivers.xsens_mtig import protocol
from drivers.xsens_mtig.mtdata2 import Kind, join, split, write_item
from tests.drivers import lms100, lux, mtig, utm30lx


def test_lms100_that_repeats_its_scan_is_reported_to_stall():
    t = lms100.talk().run(4.0)
    receive, before = t.session.receive_data, len(t.frames)
    first: list[bytes] = []

    def repeat(data: bytes, arrived_ns: int) -> Any:
        """The device's scans are all the same to the last bit."""
        first.append(data)
        return receive(first[0], arrived_ns)

    t.session.receive_data = repeat
    with pytest.raises(TransportError, match=r"\d\d+ scans came in 2 s, all with the same stamp; the sensor"):
        t.run(3.0)
    assert len(t.frames) == before + 1  # the first of them


@pytest.mark.parametrize("bench", [lms100, utm30lx, lux], ids=["lms100", "utm30lx", "lux"])
def test_laser_whose_scans_all_come_out_of_order_counts_as_silent(bench: Any):
    t = bench.talk().run(6.0)
    before, t.session._gate.last_ns = len(t.frames), t.now_ns + 1_000_000_000_000
    with pytest.raises(TransportError, match="all stamped no later than the one before; its clock"):
        t.run(2.5)
    assert before > 25
    assert len(t.frames) == before


def with_items(data: bytes, items: dict[int, Any]) -> bytes:
    """The data messages of an MTi, of which nothing else comes, with some of their items replaced."""
    messages = protocol.MessageDecoder().receive_data(data)
    return b"".join(
        protocol.encode(
            message.mid,
            join((i, write_item(i, items[i]) if i in items else item) for i, item in split(message.data)),
        )
        for message in messages
    )


@pytest.mark.parametrize(
    ("items", "words"),
    [
        ({Kind.RATE: (0.0, math.nan, 0.0)}, "with values that are no numbers; switch its power off and on"),
        ({Kind.SAMPLE_TIME_FINE: 5}, "stamped no later than the one before; its clock stalls"),
    ],
)
def test_mtig_whose_samples_are_no_use_is_not_taken_for_an_unplugged_one(items: dict[int, Any], words: str):
    t = mtig.talk(mtig.mtdata2()).run(3.0)
    receive, before = t.session.receive_data, len(t.frames)
    t.session.receive_data = lambda data, arrived_ns: receive(with_items(data, items), arrived_ns)
    with pytest.raises(TransportError, match=rf"\d\d\d samples came in 2 s, all {words}"):
        t.run(3.0)
    assert len(t.frames) - before < 20  # fixes
