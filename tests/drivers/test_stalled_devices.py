"""Devices whose messages come whole and are no use: the error says so instead of asking for the cable."""

import math
from typing import Any

import pytest

from drivers.errors import TransportError
from drivers.xsens_mtig import protocol
from drivers.xsens_mtig.mtdata2 import Kind, join, split, write_item
from tests.drivers import lms100, mtig


def test_lms100_that_repeats_its_scan_is_said_to_stall():
    t = lms100.talk().run(4.0)
    scan, before = t.device._last_scan, len(t.frames)
    t.device._measure = lambda index: scan
    with pytest.raises(TransportError, match=r"\d\d+ scans came in 2 s, all with the same stamp; the sensor"):
        t.run(3.0)
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
