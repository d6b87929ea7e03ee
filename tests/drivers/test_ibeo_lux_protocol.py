"""Framing of the LUX: any cutting, garbage, spoilt headers, and mutated messages of a real device."""

import pytest

from drivers.errors import ProtocolError
from drivers.ibeo_lux.messages import ErrorRegisters, read_command
from drivers.ibeo_lux.protocol import (
    MAGIC,
    MAX_GARBAGE_BYTES,
    MAX_MESSAGE_BYTES,
    DataType,
    Decoder,
    Message,
    encode,
    ntp_difference_ns,
    ntp_from_unix_ns,
)
from tests.drivers.lux import scan, wire

# Commands as libsick_ldmrs and the Ibeo SDK send them, device id 7.
HEADER = "affec0c2000000000000000{}000720100000000000000000"
COMMANDS = [
    (HEADER.format(4) + "01000000", 0x0001, ""),
    (HEADER.format(4) + "20000000", 0x0020, ""),
    (HEADER.format("a") + "10000000001140060000", 0x0010, "001140060000"),
    (HEADER.format("a") + "10000000011180f80000", 0x0010, "011180f80000"),
    (HEADER.format(6) + "110000000233", 0x0011, "0233"),
]
SCAN = wire(scan((0, 0, 0x50, 1600, 125, 144), (1, 0, 0x50, 1600, 125, 168)))
ERRORS = encode(Message(DataType.ERRORS, ErrorRegisters(errors_1=2).write(), ntp=5 << 32))
OBJECTS = encode(Message(DataType.OBJECTS, bytes(10)))
REPLY = encode(Message(DataType.REPLY, b"\x20\x00"))
GOOD = Message(DataType.SENSOR_INFO, b"the next good one", 3, 12345)


@pytest.mark.parametrize(("hexes", "command", "body"), COMMANDS)
def test_commands_of_known_clients_are_read_and_written_byte_for_byte(hexes, command, body):
    data = bytes.fromhex(hexes)
    [message] = Decoder().receive_data(data)
    assert (message.data_type, message.device_id, message.ntp) == (DataType.COMMAND, 7, 0)
    assert read_command(message.payload) == (command, bytes.fromhex(body))
    assert encode(message) == data


def test_messages_survive_any_cutting_of_the_stream():
    stream = SCAN + ERRORS + OBJECTS + REPLY + SCAN
    whole = Decoder().receive_data(stream)
    assert b"".join(map(encode, whole)) == stream
    for size in (1, 2, 3, 7, 24, 25, 61):
        decoder = Decoder()
        segments = [stream[i : i + size] for i in range(0, len(stream), size)]
        assert [m for part in segments for m in decoder.receive_data(part)] == whole
        assert decoder.skipped_bytes == decoder.cut_messages == 0


@pytest.mark.parametrize("garbage", [b"x", MAGIC[:3], MAGIC, MAGIC + bytes(20), MAGIC[:1] * 5, bytes(5000)])
@pytest.mark.parametrize("size", [1, 10_000])
def test_garbage_before_a_message_is_skipped_and_counted(garbage, size):
    decoder, stream, messages = Decoder(), garbage + encode(GOOD), []
    for i in range(0, len(stream), size):
        messages += decoder.receive_data(stream[i : i + size])
    assert messages[-1] == GOOD
    assert decoder.skipped_bytes == len(garbage)


def test_size_spoilt_upwards_costs_one_message():
    for size in (len(SCAN) - 24 + extra for extra in (1, 2, 3, 4, 20, 1000, 100_000)):
        spoilt = SCAN[:8] + size.to_bytes(4, "big") + SCAN[12:]
        decoder = Decoder()
        messages = [m for byte in spoilt + encode(GOOD) + REPLY for m in decoder.receive_data(bytes([byte]))]
        assert messages[-2:] == [GOOD, *Decoder().receive_data(REPLY)]


def test_size_beyond_the_limit_and_a_type_that_cannot_be_are_no_messages():
    huge = SCAN[:8] + (MAX_MESSAGE_BYTES + 1).to_bytes(4, "big") + SCAN[12:]
    odd = SCAN[:14] + b"\xff\xff" + SCAN[16:]
    decoder = Decoder()
    assert decoder.receive_data(huge + odd + encode(GOOD)) == [GOOD]
    assert decoder.bad_headers == 2


def test_payload_that_ends_like_a_magic_word_is_whole_at_once():
    for tail in (b"\xaf", b"\xaf\xfe", b"\xaf\xfe\xc0"):
        message = Message(DataType.SENSOR_INFO, b"payload" + tail)
        decoder = Decoder()
        assert decoder.receive_data(encode(message)) == [message]
        assert decoder.receive_data(encode(GOOD)) == [GOOD]
        assert decoder.skipped_bytes == 0


def test_endless_garbage_is_refused_in_words():
    decoder = Decoder()
    for kilobytes in range(1, MAX_GARBAGE_BYTES // 1024 + 1):
        assert decoder.receive_data(b"\x02sSN LMDscandata" * 64) == []
        assert decoder.skipped_bytes > kilobytes * 1024 - 4  # none is kept
    with pytest.raises(ProtocolError, match="is this port 12002"):
        decoder.receive_data(b"\x02sSN LMDscandata" * 64)


@pytest.mark.parametrize("unix_s", [0, 1_795_000_000, 2_085_978_495, 2_085_978_496])
def test_ntp_stamps_go_on_over_the_end_of_their_era(unix_s):
    ns = unix_s * 1_000_000_000
    stamp = ntp_from_unix_ns(ns)
    assert stamp >> 32 == (unix_s + 2_208_988_800) % 2**32
    assert abs(ntp_difference_ns(ntp_from_unix_ns(ns + 123_456_789), stamp) - 123_456_789) <= 1
    assert abs(ntp_difference_ns(stamp, ntp_from_unix_ns(ns + 987_654_321)) + 987_654_321) <= 1
