"""Coded scans: both directions, every kind, damaged ones, and what decoding costs."""

import numpy as np
import pytest

from drivers.errors import ProtocolError
from drivers.hokuyo_utm30lx.protocol import Reply, ReplyDecoder, checksum, encode_number
from drivers.hokuyo_utm30lx.scans import NO_ECHO, ScanRequest, read_request, read_scan, write_scan
from tests.drivers.utm30lx import random_scan

KINDS = ("GD", "GS", "GE", "MD", "MS", "ME", "HD", "HE", "ND", "NE")


def reply(wire):
    (only,) = ReplyDecoder().receive_data(wire)
    return only


@pytest.mark.parametrize("command", KINDS)
@pytest.mark.parametrize(("first", "last", "cluster"), [(0, 1080, 1), (5, 6, 0), (100, 203, 7)])
@pytest.mark.parametrize("seed", range(3))
def test_scan_survives_the_wire(command, first, last, cluster, seed):
    streams = command[0] in "MN"
    request = ScanRequest(command, first, last, cluster, 3 if streams else 0, 42 if streams else 0)
    scan = random_scan(seed, request)
    wire = write_scan(scan)
    back = read_scan(reply(wire))
    assert back.request == request
    assert back.stamp_ms == scan.stamp_ms
    rows = len(back.distance_mm)
    np.testing.assert_array_equal(back.distance_mm, scan.distance_mm[:rows])
    np.testing.assert_array_equal(back.intensity, scan.intensity[:rows])
    assert (scan.distance_mm[rows:] == NO_ECHO).all()
    assert write_scan(back) == wire


def test_requests_read_as_they_are_written():
    assert read_request("MD0000108001000") == ScanRequest("MD", 0, 1080, 1, 0, 0)
    assert read_request("NE0010020002399;abc") == ScanRequest("NE", 10, 200, 2, 3, 99)
    assert read_request("GE0000000100").beam_count == 2
    assert ScanRequest("MD", 0, 1080, 3).beam_count == 361
    for text in ("MD0000108001000", "GS0001000203", "HE0000108001"):
        assert read_request(text).text == text
    for text in ("", "VV", "MD00001080010", "MD000010800100x", "MD0100000001000", "GD00001080010 0"):
        with pytest.raises(ProtocolError):
            read_request(text)


def data_line(text):
    return text + bytes([checksum(text)]) + b"\n"


STAMP = data_line(encode_number(77, 4))


@pytest.mark.parametrize(
    ("body", "diagnostic"),
    [
        (b"", "stamp"),
        (b"000\n" + data_line(b"000111"), "stamp"),
        (STAMP, "no values"),
        (STAMP + b"000111", "no values"),
        (STAMP + b"\n", "line of"),
        (STAMP + data_line(b"0" * 65), "line of"),
        (STAMP + b"000111~\n", "wrong sum"),
        (STAMP + data_line(b"00011"), "whole number"),
        (STAMP + data_line(b"000111222"), "3 beams"),
        (STAMP + data_line(b"000"), "1 beam,"),
        (STAMP + data_line(b"000 11"), "six-bit"),
    ],
)
def test_damaged_scans_are_refused_with_a_reason(body, diagnostic):
    with pytest.raises(ProtocolError, match=diagnostic):
        read_scan(Reply("MD0000000101000", "99", body))
    assert read_scan(Reply("MD0000000101000", "99", STAMP + data_line(b"000111")))


@pytest.mark.parametrize(
    "text", [b"&000111", b"00&0111", b"000111&", b"000&&111222", b"000&111&222&333444", b"&", b"000&11"]
)
def test_ampersands_in_wrong_places_are_refused(text):
    with pytest.raises(ProtocolError):
        read_scan(Reply("ND0000000101000", "99", STAMP + data_line(text)))


def test_further_echoes_stand_below_the_beam_they_belong_to():
    scan = read_scan(Reply("ND0000000201000", "99", STAMP + data_line(b"001002&003&004005&006")))
    assert scan.distance_mm.tolist() == [[1, 2, 5], [NO_ECHO, 3, 6], [NO_ECHO, 4, NO_ECHO]]
