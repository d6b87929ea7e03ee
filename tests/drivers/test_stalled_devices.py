"""Devices that are silent, or whose messages come whole and are no use: the error names the cause."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest

from drivers.errors import TransportError
from drivers.hokuyo_utm30lx.driver import HokuyoUtm30lxSession
from drivers.ibeo_lux.driver import IbeoLuxSession
from drivers.irobot_create.driver import session_maker as create_sessions
from drivers.link import Session
from drivers.sick_lms100.driver import Lms100Session
from drivers.sick_lms100.protocol import Decoder, encode
from drivers.sick_lms100.telegrams import read_scan, write_scan
from drivers.xsens_mtig import protocol
from drivers.xsens_mtig.driver import XsensMtigSession
from drivers.xsens_mtig.mtdata2 import Kind, join, split, write_item
from tests.drivers import irobot_bench, lms100, lux, mtig, utm30lx
from tests.drivers.virtual_time import SECOND_NS, Talk
from tests.silent_device import SilentDevice


@pytest.mark.parametrize(
    ("session", "words"),
    [
        (Lms100Session(lms100.config()), "CoLa-A or CoLa-B after 20 requests"),
        (HokuyoUtm30lxSession(utm30lx.config()), "no answer to 15 times QT"),
        (IbeoLuxSession(lux.config(), lambda: 0), "no answer to 40 times Get status and no scan"),
        (XsensMtigSession(mtig.config()), "no answer in 15 s at any baud rate; is it powered"),
        (XsensMtigSession(mtig.config(baud=115_200)), "at 115200 baud.*baud: auto looks for another rate"),
        (XsensMtigSession(mtig.config(device="usb")), "over USB; unplug it"),
        (create_sessions(irobot_bench.CONFIG)(), r"no answer to Start \(128\) in 8 s.*Clean button.*BRC"),
        (create_sessions(irobot_bench.CREATE1)(), r"no answer to Start \(128\) in 8 s"),
    ],
)
def test_device_that_never_answers_is_given_up_with_advice(session: Session, words: str):
    with pytest.raises(TransportError, match=words):
        Talk(session, SilentDevice()).connect().run(60.0)


@pytest.mark.parametrize("bench", [lms100, utm30lx, lux, mtig], ids=["lms100", "utm30lx", "lux", "mtig"])
def test_time_in_which_the_host_did_not_look_is_no_silence(bench: Any):
    t = bench.talk().run(6.0)
    t.now_ns += 60 * SECOND_NS
    before = len(t.run(0.1).frames)
    t.run(1.0)
    assert t.session.status.startswith("streaming")
    assert len(t.frames) > before + 20


def changed(t: Talk, change: Callable[[bytes], bytes], arrives_ns: int = 0) -> Talk:
    """From now on the session reads what the change makes of the device's messages."""
    receive = t.session.receive_data
    t.session.receive_data = lambda data, at_ns: receive(change(data), at_ns + arrives_ns)
    return t


@pytest.mark.parametrize("bench", [lms100, utm30lx], ids=["lms100", "utm30lx"])
def test_laser_that_repeats_its_scan_is_reported_to_stall(bench: Any):
    t = bench.talk().run(4.0)
    before, first = len(t.frames), []

    def repeat(data: bytes) -> bytes:
        first.append(data)
        return first[0]

    with pytest.raises(TransportError, match=r"\d\d+ scans came in 2 s, all with the same stamp; the sensor"):
        changed(t, repeat).run(3.0)
    assert len(t.frames) == before + 1  # the first of them


@pytest.mark.parametrize("bench", [lms100, utm30lx, lux], ids=["lms100", "utm30lx", "lux"])
def test_laser_whose_scans_all_come_out_of_order_counts_as_silent(bench: Any):
    t = bench.talk().run(6.0)
    before = len(t.frames)
    with pytest.raises(TransportError, match="all stamped no later than the one before; its clock"):
        changed(t, lambda data: data, arrives_ns=-10 * SECOND_NS).run(2.5)
    assert len(t.frames) == before > 25


@pytest.mark.parametrize("after_s", [0.0, 4.0])
def test_lms100_whose_scans_state_a_rate_of_0_hz_counts_as_silent(after_s: float):
    def without_rate(data: bytes) -> bytes:
        telegrams = Decoder().receive_data(data)
        return b"".join(
            encode(write_scan(replace(read_scan(t), frequency_chz=0), t.dialect))
            if t.name == "LMDscandata" and t.kind == "sSN"
            else encode(t)
            for t in telegrams
        )

    t = changed(lms100.talk().run(after_s), without_rate)
    with pytest.raises(TransportError, match="scans came in 2 s, all with a scan rate of 0 Hz; the sensor"):
        t.run(10.0)
    assert t.session.status == "streaming; scans with a scan rate of 0 Hz, not used"


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
    before = len(t.frames)
    with pytest.raises(TransportError, match=rf"\d\d\d samples came in 2 s, all {words}"):
        changed(t, lambda data: with_items(data, items)).run(3.0)
    assert len(t.frames) - before < 20  # fixes
