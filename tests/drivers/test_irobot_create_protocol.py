from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.errors import ProtocolError
from drivers.irobot_create.driver import STREAM_IDS
from drivers.irobot_create.protocol import (
    LONGEST_TEXT_LINE,
    PACKETS,
    Command,
    CommandDecoder,
    Opcode,
    PacketId,
    StreamDecoder,
    TextCollector,
    banner_identity,
    decode_values,
    encode_frame,
    encode_query,
    encode_stream_request,
    is_banner,
)
from tests.drivers.damage import buffered

# Open Interface manual, opcode 148: cliff front left signal and virtual wall. The manual's prose reads the
# signal's bytes as decimal (549); what stands on the wire is 0x0219.
MANUAL_IDS = (29, 13)
MANUAL_REQUEST = bytes.fromhex("94 02 1D 0D")
MANUAL_FRAME = bytes.fromhex("13 05 1D 02 19 0D 00 A3")
MANUAL_VALUES = {29: 0x0219, 13: 0}


def values_of(left: int, right: int) -> dict[int, int]:
    return {PacketId.LEFT_ENCODER: left, PacketId.RIGHT_ENCODER: right, PacketId.VOLTAGE: 0x1313}


def frame(left: int = 0x1313, right: int = 19) -> bytes:
    """A frame full of the header's own value."""
    return encode_frame(STREAM_IDS, values_of(left, right))


def encoders(decoder: StreamDecoder, data: bytes) -> list[tuple[int, int]]:
    return [(f.values[43], f.values[44]) for f in decoder.receive_data(data)]


def test_stream_frame_of_the_manual_is_read_and_written():
    assert encode_stream_request(MANUAL_IDS) == MANUAL_REQUEST
    assert encode_frame(MANUAL_IDS, MANUAL_VALUES) == MANUAL_FRAME
    (got,) = StreamDecoder(MANUAL_IDS).receive_data(MANUAL_FRAME)
    assert got.values == MANUAL_VALUES
    assert (got.bytes_after, got.damaged_bytes_before) == (0, 0)


def test_answer_of_the_wrong_length_is_refused():
    with pytest.raises(ProtocolError, match=r"answer of 79 bytes to packets .*, expected 80"):
        decode_values([100], bytes(79))


def test_unknown_packets_are_refused():
    for ids in ([7, 59], [6, 200]):
        with pytest.raises(ProtocolError, match="does not exist"):
            encode_query(ids)


def test_frames_survive_any_cutting_of_the_stream():
    stream = frame(1, 2) + frame() + frame(3, 4)
    expected = [(1, 2), (0x1313, 19), (3, 4)]
    assert encoders(StreamDecoder(STREAM_IDS), stream) == expected
    for cut in range(len(stream)):
        decoder = StreamDecoder(STREAM_IDS)
        assert encoders(decoder, stream[:cut]) + encoders(decoder, stream[cut:]) == expected
        assert decoder.bytes_skipped == 0
    decoder = StreamDecoder(STREAM_IDS)
    assert [e for byte in stream for e in encoders(decoder, bytes([byte]))] == expected


def test_joining_midway_costs_the_first_frame_alone():
    for cut in range(1, 37):
        decoder = StreamDecoder(STREAM_IDS)
        assert encoders(decoder, frame()[cut:] + frame(5, 6) + frame(7, 8)) == [(5, 6), (7, 8)]
        assert decoder.bytes_skipped == 37 - cut


def test_flipped_bit_costs_one_frame_and_is_counted():
    for position in range(37):
        damaged = bytearray(frame())
        damaged[position] ^= 0x40
        decoder = StreamDecoder(STREAM_IDS)
        frames = decoder.receive_data(bytes(damaged) + frame(5, 6))
        assert [f.values[43] for f in frames] == [5]
        assert frames[0].damaged_bytes_before == 37
        assert decoder.bytes_skipped == 37
        assert decoder.checksum_failures <= 1
    assert decoder.checksum_failures == 1  # the checksum itself


def test_frame_of_another_stream_is_skipped():
    decoder = StreamDecoder(STREAM_IDS)
    assert encoders(
        decoder, MANUAL_FRAME + encode_frame(STREAM_IDS[::-1], values_of(1, 2)) + frame(5, 6)
    ) == [(5, 6)]
    assert decoder.bytes_skipped == len(MANUAL_FRAME) + 37


FLASH_LINE = "Flash CRC successful: 0x0 (0x0)"
FLASH_TEXT = f"    {FLASH_LINE}\n\r".encode()


def test_text_between_frames_costs_nothing():
    decoder = StreamDecoder(STREAM_IDS)
    frames = decoder.receive_data(frame(1, 2) + FLASH_TEXT + frame(5, 6))
    assert [(f.values[43], f.damaged_bytes_before) for f in frames] == [(1, 0), (5, 0)]
    assert decoder.lines == [FLASH_LINE]
    assert decoder.text_bytes == decoder.bytes_skipped == len(FLASH_TEXT)


def test_captured_text_is_survived(shared: Path):
    text = (shared / "captures/irobot/create2_flash_crc_unsolicited_a.bin").read_bytes()
    for position in range(38):
        decoder = StreamDecoder(STREAM_IDS)
        stream = frame()[:position] + text + frame()[position:] + frame(5, 6)
        assert encoders(decoder, stream)[-1] == (5, 6)
        assert any("Flash C" in line for line in decoder.lines)


def test_captured_banner_is_recognised(shared: Path):
    banner = (shared / "captures/irobot/create2_reset_banner_pycreate2_issue1.bin").read_bytes()
    decoder = StreamDecoder(STREAM_IDS)
    assert encoders(decoder, banner + b"\n" + frame(5, 6)) == [(5, 6)]
    assert is_banner(decoder.lines[0])
    identity: dict[str, str] = {}
    for line in decoder.lines:
        identity |= banner_identity(line)
    assert identity == {"bootloader": "2007-05-14-1715-L"}


def test_endless_text_is_bounded():
    collector = TextCollector()
    for _ in range(100_000):
        collector.add(ord("x"))
    assert len(collector.lines) == TextCollector.MAX_LINES
    assert max(map(len, collector.lines)) <= LONGEST_TEXT_LINE


@given(st.lists(st.binary(max_size=80), max_size=12))
def test_decoder_takes_anything_and_finds_the_next_good_frame(chunks: list[bytes]):
    decoder = StreamDecoder(STREAM_IDS)
    before = sum(len(decoder.receive_data(chunk)) for chunk in chunks)
    after = encoders(decoder, frame(1, 2) * 2 + frame(5, 6))
    # what is pending of the noise may take the first two for its own; nothing more
    assert after[-1] == (5, 6)
    assert buffered(decoder) < 37
    assert decoder.bytes_skipped == sum(map(len, chunks)) + 3 * 37 - 37 * (before + len(after))


@given(st.data())
def test_decoder_never_invents_frames_from_a_damaged_stream(data: st.DataObject):
    sent = data.draw(st.lists(st.tuples(st.integers(0, 65_535), st.integers(0, 65_535)), max_size=8))
    stream = bytearray(b"".join(frame(*counts) for counts in sent))
    if stream:
        position = data.draw(st.integers(0, len(stream) - 1))
        stream[position] ^= data.draw(st.integers(1, 255))
        sent.pop(position // 37)
    assert encoders(StreamDecoder(STREAM_IDS), bytes(stream)) == sent


DIALOGUE = [
    (bytes([128]), Command(Opcode.START)),
    (bytes([131]), Command(Opcode.SAFE)),
    (bytes.fromhex("89 FF 38 01 F4"), Command(Opcode.DRIVE, bytes.fromhex("FF 38 01 F4"))),
    (bytes([140, 0, 2, 70, 10, 72, 20]), Command(Opcode.SONG, bytes([0, 2, 70, 10, 72, 20]))),
    (bytes([140, 1, 0]), Command(Opcode.SONG, bytes([1, 0]))),
    (MANUAL_REQUEST, Command(Opcode.STREAM, bytes([2, 29, 13]))),
    (bytes([148, 0]), Command(Opcode.STREAM, bytes([0]))),
    (bytes([164, 32, 32, 32, 32]), Command(Opcode.DIGIT_LEDS_ASCII, b"    ")),
    (bytes([167]) + bytes(15), Command(Opcode.SCHEDULE, bytes(15))),
    (bytes([173]), Command(Opcode.STOP)),
]


def test_robot_hears_commands_however_they_are_cut():
    wire = b"".join(sent for sent, _ in DIALOGUE)
    expected = [command for _, command in DIALOGUE]
    assert CommandDecoder().receive_data(wire) == expected
    ear = CommandDecoder()
    assert [command for byte in wire for command in ear.receive_data(bytes([byte]))] == expected


def test_next_header_cannot_stand_in_for_a_lost_checksum():
    """Every byte in turn is 0x13 and gets lost, so that the sum over what follows is right again."""
    values = values_of(0x1313, 0x1313) | {i: 19 for i in STREAM_IDS[2:-1] if PACKETS[i] in "Bb"}
    whole = encode_frame(STREAM_IDS, values)
    for position in range(37):
        decoder = StreamDecoder(STREAM_IDS)
        damaged = whole[:position] + whole[position + 1 :]
        assert encoders(decoder, damaged + frame(5, 6)) == [(5, 6)]
