"""Framing of Xsens messages: known ones, damaged ones, any."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.xsens_mtig.protocol import (
    BAUD_OF_CODE,
    CODE_OF_BAUD,
    MAX_DATA_BYTES,
    Message,
    MessageDecoder,
    Mid,
    encode,
    error_text,
    warning_text,
)

CAPTURES = [f"einride_xsens-go_t{n}_output.bin" for n in (1, 2, 3)]
GOOD = encode(Mid.MTDATA2, bytes.fromhex("102002DFC5"))

# MT0101P, chapters 5 and 6.
KNOWN = [
    ("FAFF3000D1", Mid.GO_TO_CONFIG, ""),
    ("FAFF3100D0", Mid.GO_TO_CONFIG + 1, ""),
    ("FAFF1000F1", Mid.GO_TO_MEASUREMENT, ""),
    ("FAFF4000C1", Mid.RESET, ""),
    ("FAFF3E00C3", Mid.WAKE_UP, ""),
    ("FAFF3F00C2", Mid.WAKE_UP_ACK, ""),
    ("FAFF000001", Mid.REQ_DEVICE_ID, ""),
    ("FAFF1800E9", Mid.BAUDRATE, ""),
    ("FAFF18018068", Mid.BAUDRATE, "80"),
    ("FAFFD00031", Mid.OUTPUT_MODE, ""),
    ("FAFF420104BA", Mid.ERROR, "04"),
    ("FAFF6402000299", Mid.SCENARIO, "0002"),
    ("FAFF48080000001000000000A1", Mid.OPTION_FLAGS, "0000001000000000"),
    ("FAFF8E02000071", Mid.STRING_OUTPUT, "0000"),
]


@pytest.mark.parametrize(("wire", "mid", "data"), KNOWN)
def test_messages_of_the_manual_are_coded_and_read(wire: str, mid: int, data: str):
    assert encode(mid, bytes.fromhex(data)).hex().upper() == wire
    assert MessageDecoder().receive_data(bytes.fromhex(wire)) == [Message(mid, bytes.fromhex(data))]


@pytest.mark.parametrize("name", CAPTURES)
def test_recordings_of_an_mti_g_710_are_read_whole_and_made_again(shared: Path, name: str):
    recorded = (shared / "captures/xsens" / name).read_bytes()
    decoder = MessageDecoder()
    messages = decoder.receive_data(recorded)
    assert len(messages) == 100
    assert {message.mid for message in messages} == {Mid.MTDATA2}
    assert (decoder.skipped_bytes, decoder.bad_checksums) == (0, 0)
    assert b"".join(encode(m.mid, m.data, m.bus_id) for m in messages) == recorded
    singly = MessageDecoder()
    assert [m for byte in recorded for m in singly.receive_data(bytes([byte]))] == messages


def test_long_messages_have_two_more_length_bytes():
    for size in (254, 255, 2048):
        data = bytes(i & 0xFF for i in range(size))
        wire = encode(Mid.MTDATA2, data)
        assert len(wire) == size + (5 if size < 255 else 7)
        [message] = MessageDecoder().receive_data(wire)
        assert message.data == data
        assert message.wire_bytes == len(wire)
    with pytest.raises(ValueError, match="2049 bytes"):
        encode(Mid.MTDATA2, bytes(MAX_DATA_BYTES + 1))


def test_both_bus_ids_are_heard():
    [message] = MessageDecoder().receive_data(encode(Mid.REQ_DEVICE_ID, b"", 1))
    assert message.bus_id == 1
    assert MessageDecoder().receive_data(encode(Mid.REQ_DEVICE_ID, b"", 2)) == []


def test_bytes_read_behind_a_message_are_known():
    first, second = MessageDecoder().receive_data(GOOD + encode(Mid.WAKE_UP) + b"\xfa\xff\x36")
    assert (first.bytes_after, second.bytes_after) == (8, 3)


def test_a_message_with_a_bad_checksum_costs_itself_alone():
    bad = bytearray(GOOD)
    bad[5] ^= 1
    decoder = MessageDecoder()
    assert decoder.receive_data(GOOD + bytes(bad) + GOOD) == [Message(Mid.MTDATA2, GOOD[4:-1])] * 2
    assert decoder.bad_checksums == 1
    assert decoder.skipped_bytes == len(bad)


@pytest.mark.parametrize("head", ["FAFF36FF0000", "FAFF36FFFFFF", "FAFF3DFF0200", "FA00", "FAFA"])
def test_lengths_and_ids_that_cannot_be_are_no_message(head: str):
    decoder = MessageDecoder()
    assert decoder.receive_data(bytes.fromhex(head) + GOOD) == [Message(Mid.MTDATA2, GOOD[4:-1])]
    assert decoder.skipped_bytes == len(head) // 2


@given(st.lists(st.binary(max_size=400), max_size=30))
def test_any_bytes_are_survived_in_bounded_memory(chunks: list[bytes]):
    decoder = MessageDecoder()
    for chunk in chunks:
        decoder.receive_data(chunk)
        assert decoder.waiting_bytes <= MAX_DATA_BYTES + 7
    found = decoder.receive_data(GOOD * 400)  # longer than any message that garbage can announce
    assert found[-1] == Message(Mid.MTDATA2, GOOD[4:-1])
    assert found[-1].bytes_after == 0


def test_baud_codes_are_those_of_the_manual():
    assert (CODE_OF_BAUD[115_200], CODE_OF_BAUD[460_800], CODE_OF_BAUD[9_600]) == (0x02, 0x00, 0x09)
    assert CODE_OF_BAUD[921_600] == 0x80
    assert BAUD_OF_CODE[0x0A] == BAUD_OF_CODE[0x80] == 921_600


def test_errors_and_warnings_are_reported_in_words():
    assert error_text(Message(Mid.ERROR, b"\x04")) == "error 0x04: message invalid or not implemented"
    assert error_text(Message(Mid.ERROR, b"\x28\x00\x00\x00\x12\x01")).endswith("device error (0000001201)")
    assert "in no manual" in error_text(Message(Mid.ERROR, b"\xee"))
    assert "0x00" in error_text(Message(Mid.ERROR))
    assert warning_text(Message(Mid.WARNING, b"\0\0\x01\x92")) == (
        "warning 402: no answer from the GNSS receiver"
    )
    assert warning_text(Message(Mid.WARNING, b"\0\0\x01\x91GNSS config\0")) == "warning 401: GNSS config"
    assert warning_text(Message(Mid.WARNING, b"\x07")) == "warning 07"
