"""CoLa framing, fields and scan telegrams.

Real bytes are from an LMS111 recorded in SICKAG/sick_scan_xd, commit 9a10d30b, test/emulator/scandata.
"""

import json
import struct
from dataclasses import replace

import numpy as np
import pytest

from drivers.errors import ProtocolError
from drivers.sick_lms100 import telegrams
from drivers.sick_lms100.protocol import (
    MAX_GARBAGE_BYTES,
    MAX_TELEGRAM_BYTES,
    AsciiReader,
    Decoder,
    Dialect,
    Telegram,
    encode,
    refusal_text,
    writer,
)
from tests.drivers.damage import buffered

ASCII, BINARY = Dialect.ASCII, Dialect.BINARY

REAL = [
    ("020202020000001173524e205343646576696365737461746530", Telegram(BINARY, "sRN", "SCdevicestate")),
    (
        "0202020200000013735241205343646576696365737461746520001f",
        Telegram(BINARY, "sRA", "SCdevicestate", b"\0"),
    ),
    ("020202020000000e735741204549487374436f6c612007", Telegram(BINARY, "sWA", "EIHstCola", b"")),
    ("0202020200000007734d4e2052756e19", Telegram(BINARY, "sMN", "Run")),
    ("0202020200000011734541204c4d447363616e6461746120013c", Telegram(BINARY, "sEA", "LMDscandata", b"\1")),
    ("0202020200000005734641000377", Telegram(BINARY, "sFA", "", b"\0\3")),  # LMS511
    (
        b"\x02sRA STlms 7 0 8 00:34:19 A 01.01.1970 0 0 0\x03".hex(),
        Telegram(ASCII, "sRA", "STlms", b"7 0 8 00:34:19 A 01.01.1970 0 0 0"),
    ),
    (b"\x02sFA 4\x03".hex(), Telegram(ASCII, "sFA", "", b"4")),
    (b"\x02sWA LMDscandatacfg\x03".hex(), Telegram(ASCII, "sWA", "LMDscandatacfg")),
]
IDS = [telegram.kind + " " + telegram.name + " " + telegram.dialect.value for _, telegram in REAL]

BEAMS = np.array([93, 80, 0, 1, 2, 3, 15, 16, 20_000, 65_535], dtype=np.uint16)
SCAN = telegrams.ScanTelegram(
    serial_number=18_090_362,
    status=(1, 0),
    telegram_counter=63_336,
    scan_counter=4,
    start_us=1_948_810_585,
    sent_us=1_948_813_715,
    frequency_chz=5000,
    shots_100hz=360,
    channels_16bit=(
        telegrams.Channel("DIST1", BEAMS, -450_000, 5000),
        telegrams.Channel("DIST2", BEAMS[::-1].copy(), -450_000, 5000, 2.0),
    ),
    channels_8bit=(telegrams.Channel("RSSI1", (BEAMS % 256).astype(np.uint16), -450_000, 5000),),
    outputs=(7, 0),
    encoders=((4_000_000_000, 65_535),),
    position=(1.0, -2.0, 0.0, 0.5, 0.0, 3.25, 2.0),
    name="not defined",
    comment="",
    time=telegrams.Calendar(1970, 1, 1, 2, 55, 34, 889_000),
    event=telegrams.Event("FDIN", 1, 2, -450_000),
)


def same(a, b):
    """Equality of scans with their arrays."""
    pairs = list(zip(a.channels_16bit + a.channels_8bit, b.channels_16bit + b.channels_8bit, strict=True))
    bare = {"channels_16bit": (), "channels_8bit": ()}
    fields = [f for f in a.__dataclass_fields__ if f not in bare]
    return all(getattr(a, f) == getattr(b, f) for f in fields) and all(
        np.array_equal(p.values, q.values)
        and (p.content, p.first_e4deg, p.step_e4deg, p.scale, p.offset)
        == (q.content, q.first_e4deg, q.step_e4deg, q.scale, q.offset)
        for p, q in pairs
    )


@pytest.mark.parametrize(("wire", "telegram"), REAL, ids=IDS)
@pytest.mark.parametrize("knows_dialect", [False, True])
def test_telegram_survives_any_cutting_of_the_stream_and_garbage_before_it(wire, telegram, knows_dialect):
    wire = bytes.fromhex(wire)
    dialect = telegram.dialect if knows_dialect else None
    assert encode(telegram) == wire
    assert Decoder(dialect).receive_data(wire) == [telegram]
    decoder = Decoder(dialect)
    assert [t for byte in wire for t in decoder.receive_data(bytes([byte]))] == [telegram]
    assert decoder.skipped_bytes == 0
    for garbage in (
        b"tail of another\x03",
        b"\x02",
        b"\x02\x02\x02",
        b"\x02sRA x",
        b"\x02\x02\x02\x02\0\0\0\x09sRN broken!",
    ):
        decoder = Decoder(dialect)
        assert decoder.receive_data(garbage + wire + wire) == [telegram, telegram], garbage
        assert decoder.skipped_bytes == len(garbage)


def test_two_dialects_in_one_stream_are_distinguished():
    wires = [bytes.fromhex(wire) for wire, _ in REAL]
    assert Decoder().receive_data(b"".join(wires)) == [telegram for _, telegram in REAL]


def test_wrong_checksum_is_counted_and_the_next_telegram_found():
    wire = bytearray.fromhex(REAL[0][0])
    wire[-1] ^= 1
    decoder = Decoder()
    assert decoder.receive_data(bytes(wire) + bytes.fromhex(REAL[1][0])) == [REAL[1][1]]
    assert decoder.bad_checksums == 1
    assert decoder.skipped_bytes == len(wire)


def test_damaged_length_does_not_swallow_what_follows():
    wire = bytearray.fromhex(REAL[0][0])
    wire[6] = 0x40  # 16 KiB announced
    good = bytes.fromhex(REAL[1][0])
    assert Decoder(BINARY).receive_data(bytes(wire) + good) == [REAL[1][1]]


@pytest.mark.parametrize("dialect", [ASCII, BINARY, None])
def test_endless_garbage_is_refused_and_the_buffer_stays_bounded(dialect):
    decoder = Decoder(dialect)

    def feed(chunk, times):
        for _ in range(times):
            decoder.receive_data(chunk)
            assert buffered(decoder) <= MAX_TELEGRAM_BYTES + len(chunk)

    with pytest.raises(ProtocolError, match="2111"):
        feed(b"\x02s" + b"0" * 998, 2 * MAX_GARBAGE_BYTES // 1000)


def test_numbers_are_hexadecimal_or_decimal_with_a_sign():
    r = AsciiReader(b"25 +25 -25 FFF92230 -450000 3F800000 1388 ffff")
    assert (r.u8(), r.u8(), r.i32(), r.i32(), r.i32()) == (37, 25, -25, -450_000, -450_000)
    assert (r.f32(), r.u16(), r.u16(), r.at_end) == (1.0, 5000, 65_535, True)


@pytest.mark.parametrize(
    ("telegram", "words"),
    [
        (Telegram(BINARY, "sFA", "", b"\0\3"), "error 3: unknown variable"),
        (Telegram(ASCII, "sFA", "", b"4"), "error 4: local condition failed"),
        (Telegram(ASCII, "sFA", "", b"1A"), "error 1A: complex arrays"),
        (Telegram(ASCII, "sFA", "", b"77"), "error 77: not in the telegram listing"),
    ],
)
def test_refusals_are_put_into_words(telegram, words):
    assert refusal_text(telegram).startswith(words)


@pytest.mark.parametrize(
    ("layout", "body"),
    [
        (telegrams.ScanConfig(5000, 5000), b"1388 1 1388 FFF92230 225510"),  # as a real LMS111 answers
        (telegrams.OutputRange(-450_000, 2_250_000), b"1 1388 FFF92230 225510"),
    ],
)
def test_configuration_is_written_as_real_devices_write_it(layout, body):
    w = writer(ASCII)
    layout.write(w)
    assert w.body == body


def test_field_of_view_rounded_by_the_vendors_tool_still_agrees():
    assert telegrams.OutputRange(-449_997, 2_250_013).agrees(telegrams.OutputRange(-450_000, 2_250_000))
    assert not telegrams.OutputRange(-445_000, 2_250_000).agrees(telegrams.OutputRange(-450_000, 2_250_000))


@pytest.mark.parametrize("body", [b"7 0 8 00:34:19 A 01.01.1970 0 0 0", b"7 0 8 00:00:00 8 01.0 1.06 0 0 0"])
def test_device_status_is_read_by_lengths_not_by_blanks(body):
    status = telegrams.DeviceStatus.read(AsciiReader(body))
    assert status.state == 7
    assert len(status.date) in (8, 10)


@pytest.mark.parametrize("dialect", [ASCII, BINARY])
def test_scan_with_every_field_survives(dialect):
    telegram = telegrams.write_scan(SCAN, dialect)
    decoded = Decoder().receive_data(encode(telegram))
    assert decoded == [telegram]
    assert same(telegrams.read_scan(decoded[0]), SCAN)


@pytest.mark.parametrize("dialect", [ASCII, BINARY])
@pytest.mark.parametrize("missing", ["position", "name", "comment", "time", "event"])
def test_scan_without_one_optional_field_survives(dialect, missing):
    scan = replace(SCAN, **{missing: None})
    assert same(telegrams.read_scan(telegrams.write_scan(scan, dialect)), scan)


@pytest.mark.parametrize("dialect", [ASCII, BINARY])
def test_scan_cut_anywhere_is_refused(dialect):
    body = telegrams.write_scan(replace(SCAN, time=None, event=None), dialect).body
    for end in range(len(body) - 2):
        with pytest.raises(ProtocolError):
            # The last flag may be missing; everything before may not.
            telegrams.read_scan(Telegram(dialect, "sSN", "LMDscandata", body[:end]))


@pytest.mark.parametrize(("offset", "what"), [(36, "encoders"), (38, "channels"), (59, "beams")])
def test_counts_beyond_reason_are_refused(offset, what):
    body = bytearray(telegrams.write_scan(replace(SCAN, encoders=()), BINARY).body)
    struct.pack_into(">H", body, offset, 60_000)
    with pytest.raises(ProtocolError, match=f"60000 {what}"):
        telegrams.read_scan(Telegram(BINARY, "sSN", "LMDscandata", bytes(body)))


def test_every_recorded_telegram_is_decoded_and_encoded_back(shared):
    lines = (shared / "captures/sick/20210302_lms111.jsonl").read_text().splitlines()
    wires = [bytes.fromhex(json.loads(line)["hex"]) for line in lines]
    decoder, scans = Decoder(), 0
    for wire in wires:
        [telegram] = decoder.receive_data(wire)
        assert encode(telegram) == wire
        if telegram.kind == "sSN" and telegram.name == "LMDscandata":
            scan = telegrams.read_scan(telegram)
            assert encode(telegrams.write_scan(scan, BINARY)) == wire
            text = telegrams.write_scan(scan, ASCII)
            assert same(telegrams.read_scan(Decoder().receive_data(encode(text))[0]), scan)
            scans += 1
    assert (len(wires), scans, decoder.skipped_bytes, decoder.bad_checksums) == (277, 175, 0, 0)


def test_first_recorded_scan_says_what_the_wire_says(shared):
    lines = (shared / "captures/sick/20210302_lms111.jsonl").read_text().splitlines()
    wire = next(
        bytes.fromhex(row["hex"]) for row in map(json.loads, lines) if b"sSN LMDs".hex() in row["hex"]
    )
    scan = telegrams.read_scan(Decoder().receive_data(wire)[0])
    assert (scan.serial_number, scan.status) == (18_090_362, (1, 0))
    assert (scan.telegram_counter, scan.scan_counter) == (63_336, 4)
    assert (scan.start_us, scan.sent_us) == (1_948_810_585, 1_948_813_715)
    assert (scan.frequency_chz, scan.shots_100hz, scan.outputs) == (5000, 360, (1, 0))
    channel = scan.channel("DIST1")
    assert (len(channel.values), channel.first_e4deg, channel.step_e4deg) == (541, -450_000, 5000)
    assert channel.values[:3].tolist() == [93, 80, 86]
    assert scan.time == telegrams.Calendar(1970, 1, 1, 2, 55, 34, 889_000)
    assert scan.channel("DIST2") is None
