"""Payloads of the LUX.

Real bytes are from a SICK LD-MRS: SICKAG/sick_scan_xd, commit 2d47966,
tools/test_server/config/test_server_ldmrs.yaml.
"""

import struct
from dataclasses import replace

import numpy as np
import pytest

from drivers.errors import ProtocolError
from drivers.ibeo_lux.messages import DeviceStatus, ErrorRegisters, read_scan, write_scan
from drivers.ibeo_lux.protocol import ntp_difference_ns

REAL_SCAN = bytes.fromhex(
    "a8030b03000038c3ce17a00000000cff7c1da0000000002d4006c0f9e4020000000000000000000000000200"
    "005040067d0090000000015040067d00a8000000004430067e00ac000000"
)
STATUS = DeviceStatus(
    0x3035,
    0x3021,
    0x030B,
    bytes(4),
    0x01EC,
    (0x0829, 123, 1),
    (0x2014, 0x0611, 0x0928),
    (0x2015, 0x0114, 0x1332),
)


def test_header_and_points_of_a_real_scan():
    scan = read_scan(REAL_SCAN)
    assert (scan.number, scan.status, scan.sync_phase, scan.flags) == (936, 0x030B, 0, 0x0002)
    assert scan.start_ntp / 2**32 == pytest.approx(160.0930, abs=1e-4)
    assert scan.end_ntp / 2**32 == pytest.approx(160.1152, abs=1e-4)
    assert ntp_difference_ns(scan.end_ntp, scan.start_ntp) == pytest.approx(22_190_000, abs=10_000)
    assert (scan.ticks_per_turn, scan.start_ticks, scan.end_ticks) == (11_520, 1600, -1600)
    assert (scan.announced_points, len(scan.points), scan.is_truncated) == (740, 3, True)
    assert scan.mounting_ticks == scan.mounting_cm == (0, 0, 0)
    assert scan.points.tolist() == [
        (0x00, 0x50, 1600, 125, 144, 0),
        (0x01, 0x50, 1600, 125, 168, 0),
        (0x00, 0x44, 1584, 126, 172, 0),
    ]


def test_whole_capture_decodes_and_encodes_to_itself(shared):
    payload = (shared / "captures/ibeo/ldmrs_scan_payload_0x2202.bin").read_bytes()
    scan = read_scan(payload)
    assert (scan.announced_points, len(scan.points), scan.spare_bytes) == (740, 139, 2)
    assert write_scan(scan) == payload[:-2]
    assert {int(layer) for layer in scan.points["layer_echo"]} == {0, 1, 2, 3}
    assert (np.diff(scan.points["angle_ticks"]) <= 0).all()
    assert np.count_nonzero(scan.points["flags"] & 0x04) == 120  # though no ground labelling ran
    upper = scan.points["angle_ticks"][scan.points["layer_echo"] >= 2]
    assert upper.max() == 1112
    whole = replace(scan, announced_points=139)
    assert read_scan(write_scan(whole)).is_truncated is False


@pytest.mark.parametrize("length", range(len(REAL_SCAN) + 1))
def test_scan_cut_anywhere_gives_the_points_that_came(length):
    if length < 44:
        with pytest.raises(ProtocolError, match="its header alone has 44"):
            read_scan(REAL_SCAN[:length])
    else:
        assert len(read_scan(REAL_SCAN[:length]).points) == (length - 44) // 10


def test_status_says_versions_serial_and_temperature():
    assert DeviceStatus.read(STATUS.write()) == STATUS
    assert len(STATUS.write()) == 30
    assert STATUS.firmware == "3.03.5 2015-01-14 13:32"  # as an LD-MRS800001S01 printed it
    assert replace(STATUS, firmware_code=0x3021, firmware_time_code=(0xFFFF,) * 3).firmware == "3.02.1"
    assert STATUS.serial == "0829-123"
    assert replace(STATUS, serial_code=(0x0009, 0x4A12, 0)).serial == "00094A120000"
    assert replace(STATUS, serial_code=(0xFFFF, 0, 1)).serial == ""
    assert STATUS.temperature_c == pytest.approx(24.0, abs=0.1)
    assert replace(STATUS, temperature_raw=0xFFFF).temperature_c is None


def test_errors_and_warnings_are_reported_in_words():
    registers = ErrorRegisters(0x0102, 0x0001, 0x0010, 0x8002)
    assert ErrorRegisters.read(registers.write()) == registers
    assert len(registers.write()) == 16
    assert registers.error_words == [
        "motor 1 fault",
        "no scan data",
        "APD temperature out of range (register 0x0100)",
    ]
    assert registers.warning_words == [
        "high temperature",
        "Ethernet blocked",
        "warning register 2 bit 0x8000",
    ]
    assert len(ErrorRegisters(0x8030).error_words) == 3  # a name a bit, so that counters stay few
    assert ErrorRegisters(errors_1=0x0300).error_words == ["APD temperature sensor defective"]
    assert ErrorRegisters().error_words == ErrorRegisters().warning_words == []
    with pytest.raises(ProtocolError, match="at least 8"):
        ErrorRegisters.read(struct.pack("<3H", 1, 2, 3))
