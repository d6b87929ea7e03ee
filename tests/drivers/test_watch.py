"""The watch over silence and the run of malformed messages."""

from collections import Counter

import pytest

from drivers.errors import ProtocolError
from drivers.watch import LOOK_NS, MalformedRun, SilenceWatch, StampGate

TICK_NS = 20_000_000


def test_silence_counts_from_the_last_frame_while_the_device_should_send():
    watch = SilenceWatch()
    for tick in range(51):
        watch.look(tick * TICK_NS, waiting=tick > 25)
    assert not watch.exceeds(0.5)
    watch.look(51 * TICK_NS, waiting=True)
    assert watch.exceeds(0.5)
    watch.heard()
    assert not watch.exceeds(0.0)


def test_a_host_that_did_not_look_heard_no_silence():
    watch = SilenceWatch()
    watch.look(0, waiting=True)
    watch.look(30_000_000_000, waiting=True)
    assert watch.exceeds(LOOK_NS / 1e9 - 0.001)
    assert not watch.exceeds(LOOK_NS / 1e9)


def test_malformed_messages_are_borne_up_to_the_limit_and_a_good_one_begins_anew():
    counters: Counter[str] = Counter()
    run = MalformedRun(counters, "scans", 3)
    for _ in range(2):
        for _ in range(3):
            run.bad(ProtocolError("no sense"))
        run.good()
    assert counters == {"scans_malformed": 6}
    for _ in range(3):
        run.bad(ProtocolError("no sense"))
    with pytest.raises(ProtocolError, match="4 malformed scans in a row: no sense") as raised:
        run.bad(ProtocolError("no sense"))
    assert isinstance(raised.value.__cause__, ProtocolError)


def test_a_stamp_after_its_arrival_or_not_after_the_one_before_is_counted_and_does_not_pass():
    counters: Counter[str] = Counter()
    gate = StampGate(counters, "scans")
    passed = [
        gate.passes(stamp_ns, arrived_ns) for stamp_ns, arrived_ns in ((9, 9), (9, 12), (13, 12), (10, 12))
    ]
    assert passed == [
        True,
        False,
        False,
        True,
    ]  # the one from the future is not what the next is compared with
    assert counters == {"scans_ahead_of_arrival": 1, "scans_out_of_order": 1}
    assert gate.last_ns == 10
