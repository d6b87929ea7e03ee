"""SCIP framing: whole, cut anywhere, behind garbage, too long; numbers, sums and info lines."""

import json

import pytest

from drivers.errors import ProtocolError
from drivers.hokuyo_utm30lx.protocol import (
    MAX_REPLY_BYTES,
    Reply,
    ReplyDecoder,
    checksum,
    encode_info,
    encode_reply,
    read_info,
    read_time,
)
from drivers.hokuyo_utm30lx.scans import read_scan, write_scan
from tests.drivers.damage import buffered
from tests.drivers.utm30lx import random_scan

REAL_TM1 = b"TM1\n00P\n<SfkP\n\n"
SCAN = write_scan(random_scan(0))
REPLIES = [
    (b"QT\n00P\n\n", Reply("QT", "00")),
    (b"BM\n02R\n\n", Reply("BM", "02")),
    (b"CR00\n04T\n\n", Reply("CR00", "04")),
    (b"QT\n0Ee\n\n", Reply("QT", "0E")),
    (b"SCIP2.0\n0\n\n", Reply("SCIP2.0", "0")),
    (b"QT\nE\n\n", Reply("QT", "E")),
    (b"MD0000108001000;17\n00P\n\n", Reply("MD0000108001000;17", "00")),
    (REAL_TM1, Reply("TM1", "00", b"<SfkP\n")),
]


@pytest.mark.parametrize(("wire", "reply"), REPLIES)
def test_reply_survives_any_cutting_of_the_stream(wire, reply):
    assert ReplyDecoder().receive_data(wire) == [reply]
    decoder = ReplyDecoder()
    assert [r for byte in wire for r in decoder.receive_data(bytes([byte]))] == [reply]
    assert decoder.skipped_bytes == 0
    if not reply.body:
        assert encode_reply(reply.echo, reply.status) == wire


@pytest.mark.parametrize(("wire", "reply"), REPLIES)
@pytest.mark.parametrize("before", [b"\xff\x00 noise", b"0a1b\n0c@\n", SCAN[:-2], SCAN[:1000], b"\n\n\n"])
def test_reply_is_found_behind_garbage_and_behind_the_stump_of_a_scan(wire, reply, before):
    decoder = ReplyDecoder()
    assert decoder.receive_data(before + wire)[-1] == reply
    assert decoder.skipped_bytes == len(before.lstrip(b"\n"))


def test_endless_noise_is_bounded_and_what_follows_is_read():
    decoder = ReplyDecoder()
    for _ in range(40):
        assert decoder.receive_data(b"x" * 10_000) == []
        assert buffered(decoder) <= MAX_REPLY_BYTES
    assert decoder.receive_data(b"\n\n" + SCAN)
    assert decoder.skipped_bytes == 400_001


def test_block_with_a_wrong_status_sum_is_counted_and_dropped():
    decoder = ReplyDecoder()
    assert decoder.receive_data(b"QT\n00Q\n\n") == []
    assert (decoder.unreadable_blocks, decoder.skipped_bytes) == (1, 7)


def test_all_habits_of_summing_an_info_line_are_accepted_and_no_other():
    text = b"SCSP:Initial(2400[rpm])<-Default setting by user"
    for summed in (text, text + b";", text.partition(b"<-")[0]):
        line = text + b";" + bytes([checksum(summed)]) + b"\n"
        assert read_info(Reply("II", "00", line)) == {"SCSP": text.decode()[5:]}
    with pytest.raises(ProtocolError, match="wrong sum"):
        read_info(Reply("II", "00", text + b";" + bytes([checksum(text) ^ 1]) + b"\n"))
    with pytest.raises(ProtocolError, match="KEY:value"):
        read_info(Reply("II", "00", b"nokey;" + bytes([checksum(b"nokey")]) + b"\n"))


def test_what_the_device_says_of_itself_is_shown_as_plain_short_text():
    sent = encode_info("II", [("STAT", "bad\x1b[2J\rfront: forged"), ("MODL", "x" * 30_000)])
    [reply] = ReplyDecoder().receive_data(sent)
    assert read_info(reply) == {"STAT": "bad?[2J?front: forged", "MODL": "x" * 80}
    with pytest.raises(ProtocolError, match="wrong sum") as refused:
        read_info(Reply("VV", "00", b"y" * 30_000 + b"!\n"))
    assert len(str(refused.value)) < 150


def test_time_of_a_real_unit_and_a_damaged_one():
    (reply,) = ReplyDecoder().receive_data(REAL_TM1)
    assert read_time(reply) == 3_292_603
    for body in (b"", b"<SfkQ\n", b"<Sfk\n"):
        with pytest.raises(ProtocolError, match="not a time"):
            read_time(Reply("TM1", "00", body))


def test_every_line_of_a_recorded_unit_decodes_and_encodes_to_the_same_bytes(shared):
    sent = b"".join(recorded(shared, "utm_30lx.jsonl"))
    decoder = ReplyDecoder()
    encoded = b""
    for reply in decoder.receive_data(sent):
        if reply.echo in ("VV", "PP", "II"):
            encoded += encode_info(reply.echo, list(read_info(reply).items()))
        elif reply.status == "99":
            scan = read_scan(reply)
            assert scan.stamp_ms == 4_821_609
            assert scan.distance_mm[0, :5].tolist() == [45, 48, 49, 50, 49]
            assert scan.intensity[0, :4].tolist() == [1809, 1780, 1792, 1746]
            assert (scan.intensity.min(), scan.intensity.max()) == (137, 16_219)
            assert (scan.distance_mm.min(), scan.distance_mm.max()) == (45, 5856)
            encoded += write_scan(scan)
        else:
            encoded += encode_reply(reply.echo, reply.status)
    assert encoded == sent
    assert decoder.skipped_bytes == 0


def recorded(shared, name):
    """Bytes of the device, as they were read."""
    for line in (shared / "captures" / "hokuyo" / name).read_text().splitlines():
        message = json.loads(line)
        if message["dir"] == "dev":
            yield bytes.fromhex(message["hex"])
