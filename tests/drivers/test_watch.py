"""The watch over silence and the run of malformed messages."""

from collections import Counter

import pytest

from drivers.errors import ProtocolError
from drivers.watch import NOT_FINITE, SAME_STAMP, MalformedRun, SilenceWatch, StampGate

TICK_NS = 20_000_000


def watched(reasons, seconds):
    """A watch after a frame, then a frame dropped at each tick while there are reasons, then nothing."""
    watch = SilenceWatch()
    for tick in range(round(seconds * 50) + 1):
        watch.look(tick * TICK_NS, waiting=True)
        if tick == 0:
            watch.dropped(NOT_FINITE)
            watch.heard()  # what was dropped before this frame is forgotten
        elif tick <= len(reasons):
            watch.dropped(reasons[tick - 1])
    return watch


def test_frames_that_came_and_were_dropped_are_reported_with_the_remedy():
    assert watched([SAME_STAMP] * 80, 2.0).what_came("scans", 2.0) == (
        "80 scans came in 2 s, all with the same stamp; the sensor stalls: switch its power off and on"
    )
    assert watched([NOT_FINITE] * 20 + [SAME_STAMP] * 60, 2.0).what_came("scans", 2.0) == (
        "80 scans came in 2 s, none usable: 60 with the same stamp, 20 with values that are no numbers; "
        "the sensor stalls: switch its power off and on"
    )


@pytest.mark.parametrize("dropped", [0, 1, 49])
def test_a_device_that_sends_nothing_any_more_is_silent_whatever_was_dropped_before(dropped):
    assert watched([SAME_STAMP] * dropped, 2.0).what_came("scans", 2.0) == ""


def test_malformed_messages_are_borne_up_to_the_limit_and_a_good_one_begins_again():
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
