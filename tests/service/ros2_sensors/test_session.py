import numpy as np
import pytest

from drivers.errors import ProtocolError, TransportError
from service.encoding import encode_frame
from service.ros2_sensors.session import LARGEST_MESSAGE, MALFORMED_LIMIT, Ros2Session, pack
from tests.service.ros2_sensors.nodes import PERIOD_NS, START_NS, hear, node, scan, session


@pytest.mark.parametrize("size", [1, 3, 700, 100_000])
def test_bytes_may_be_cut_anywhere(size):
    whole, segments, speaking = session(), session(), node()
    for number in range(3):
        content = pack(speaking.due(speaking.next_due_ns(0)))
        at_ns = START_NS + (number + 1) * PERIOD_NS
        (expected,) = whole.receive_data(content, at_ns)
        found = []
        for begin in range(0, len(content), size):
            found += segments.receive_data(content[begin : begin + size], at_ns)
        assert [frame.stamp_ns for frame in found] == [expected.stamp_ns]
        assert np.array_equal(found[0].range_m, expected.range_m)


def test_garbage_is_counted_and_ends_the_connection_when_nothing_else_comes():
    listening = session()
    for _ in range(MALFORMED_LIMIT):
        assert listening.receive_data(pack(b"garbage"), START_NS) == []
    with pytest.raises(ProtocolError, match=r"11 malformed scans in a row: /scan: 7 bytes cannot be read"):
        listening.receive_data(pack(b"garbage"), START_NS)
    assert listening.counters["scans_malformed"] == 11


def test_a_length_that_cannot_be_is_refused():
    with pytest.raises(ProtocolError, match="a message of 4294967295 bytes; at most"):
        session().receive_data(b"\xff\xff\xff\xff", START_NS)
    assert LARGEST_MESSAGE < 2**32


def test_stamps_that_stand_still_are_dropped_and_the_silence_says_so():
    listening = session(silence_timeout_s=0.5)
    payload = encode_frame(scan(START_NS)).payload
    assert len(listening.receive_data(pack(payload), START_NS)) == 1
    with pytest.raises(TransportError, match="all stamped no later than the one before"):
        _listen_for_a_minute(listening, pack(payload))
    assert listening.counters["scans_out_of_order"] > 5


def test_silence_ends_the_connection_with_what_to_look_at():
    listening = session(domain=3)
    with pytest.raises(TransportError) as raised:
        _listen_for_a_minute(listening)
    assert str(raised.value) == (
        "no sensor_msgs/msg/LaserScan on /scan for 5 s; does a node publish it with rmw_zenoh_cpp, on "
        "domain 3, at the router tcp/127.0.0.1:7447?"
    )


def _listen_for_a_minute(listening: Ros2Session, data: bytes = b"") -> None:
    """To the same bytes each time, of which no frame comes."""
    for number in range(1, 60 * 25):
        assert listening.receive_data(data, START_NS + number * PERIOD_NS) == []
        listening.tick(START_NS + number * PERIOD_NS)


@pytest.mark.parametrize("seconds", [3600.0, -3600.0])
def test_a_clock_that_is_set_is_learnt_again(seconds):
    listening, speaking = session(latency_ms=2.0), node()
    hear(listening, speaking, 50)
    speaking.jump_clock(seconds)
    frames = hear(listening, speaking, 150)
    assert abs(frames[-1].stamp_ns - (START_NS + 199 * PERIOD_NS)) < 100_000
    assert listening.counters["clock_resets"] == 1
