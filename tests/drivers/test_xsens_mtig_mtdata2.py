"""Items of MTData2 against recordings, the manual's example, and themselves."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.errors import ProtocolError
from drivers.xsens_mtig.mtdata2 import (
    Kind,
    Value,
    join,
    read_item,
    read_output_configuration,
    split,
    write_item,
    write_output_configuration,
)
from drivers.xsens_mtig.protocol import Message, MessageDecoder, Mid, encode
from drivers.xsens_mtig.reals import BYTES, Precision, read_reals, write_reals

# Output configuration and one message of MT0101P, their checksums verified.
MANUAL_CONFIG = "FAFFC0281020FFFF1060FFFF201000644020019080200190C0200064E020FFFF5042006450220064D012006473"
MANUAL_DATA = (
    "FAFF3631102002DFC510600400459DA040200CBEDC9AFA3F549F37411CBB7080200CBBAA5C803B8C5501BB813300"
    "E020040000008145"
)


def recorded(shared: Path, name: str) -> list[Message]:
    wire = (shared / "captures/xsens" / f"einride_xsens-go_{name}.bin").read_bytes()
    return MessageDecoder().receive_data(wire)


def values_of(data: bytes) -> dict[int, Value]:
    """By id, every item of a message."""
    return {identifier: read_item(identifier, payload) for identifier, payload in split(data)}


def made_again(data: bytes) -> bytes:
    return join((identifier, write_item(identifier, value)) for identifier, value in values_of(data).items())


def test_the_manuals_message_holds_what_it_says():
    [message] = MessageDecoder().receive_data(bytes.fromhex(MANUAL_DATA))
    items = values_of(message.data)
    assert items[0x1020] == 0xDFC5
    assert items[0x1060] == 0x00459DA0
    assert items[0x4020] == pytest.approx((-0.43087, 0.83056, 9.79576), abs=1e-4)
    assert items[0x8020] == pytest.approx((-0.005199, 0.004282, -0.003943), abs=1e-6)
    assert items[0xE020] == 0x81


def test_the_manuals_output_configuration_is_coded_and_read():
    [message] = MessageDecoder().receive_data(bytes.fromhex(MANUAL_CONFIG))
    wanted = read_output_configuration(message.data)
    assert wanted[:2] == [(0x1020, 0xFFFF), (0x1060, 0xFFFF)]
    assert (0x5042, 100) in wanted
    assert encode(Mid.OUTPUT_CONFIGURATION, write_output_configuration(wanted)).hex().upper() == MANUAL_CONFIG


@pytest.mark.parametrize("name", ["t1_output", "t2_output", "t3_output"])
def test_every_recorded_message_is_made_again_from_its_values(shared: Path, name: str):
    for message in recorded(shared, name):
        assert made_again(message.data) == message.data


@pytest.mark.parametrize("name", ["t1", "t2", "t3"])
def test_recorded_output_configurations_are_read_and_made_again(shared: Path, name: str):
    data = (shared / "captures/xsens" / f"einride_xsens-go_{name}_outputconfig.bin").read_bytes()
    wanted = read_output_configuration(data)
    assert len(wanted) == 13
    assert wanted[-1] == (Kind.GNSS_PVT, 4)
    assert write_output_configuration(wanted) == data


def test_fixed_16_32_has_its_fraction_first():
    """The y acceleration of the second recorded message in that format, -9.68 m/s^2."""
    assert read_reals(bytes.fromhex("52873000FFF6"), Precision.FP1632, 1)[0] == pytest.approx(
        -9.67762, abs=1e-5
    )
    assert write_reals((-0.5,), Precision.FP1632) == bytes.fromhex("80000000FFFF")
    assert write_reals((1.25,), Precision.FP1220) == bytes.fromhex("00140000")


@given(st.sampled_from([Precision.FP1220, Precision.FP1632]), st.binary(min_size=12, max_size=12))
def test_every_bit_pattern_of_the_fixed_formats_comes_back(precision: Precision, data: bytes):
    count = 12 // BYTES[precision]
    assert write_reals(read_reals(data, precision, count), precision) == data


def test_numbers_that_do_not_fit_are_refused():
    for value, precision in (
        (2048.0, Precision.FP1220),
        (32_768.0, Precision.FP1632),
        (1e39, Precision.FLOAT32),
    ):
        with pytest.raises(ValueError, match="do not fit"):
            write_reals((value,), precision)


@pytest.mark.parametrize(
    ("data", "diagnostic"),
    [
        ("1020", "item at byte 0 of 2"),
        ("10200200", "item at byte 0 of 4"),
        ("102003AABBCC", "3 bytes of PACKET_COUNTER, expected 2"),
        ("10200100", "1 byte of PACKET_COUNTER, expected 2"),
        ("40200B" + "00" * 11, "11 bytes of ACCELERATION, expected 12"),
        ("70105D" + "00" * 93, "93 bytes of GNSS_PVT, expected 94"),
    ],
)
def test_items_of_a_wrong_size_are_refused(data: str, diagnostic: str):
    with pytest.raises(ProtocolError, match=diagnostic):
        values_of(bytes.fromhex(data))


def test_items_no_one_knows_are_kept_as_they_are():
    data = join([(0x9999, b"abc"), (Kind.PACKET_COUNTER, b"\0\1")])
    assert values_of(data) == {0x9999: b"abc", 0x1020: 1}
    assert made_again(data) == data
