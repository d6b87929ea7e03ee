"""Legacy MTData against traces of a real MTi-G, and every layout against itself."""

import struct
from pathlib import Path

import pytest

from drivers.errors import ProtocolError
from drivers.xsens_mtig.mtdata import KNOWN_MODE, Layout, LegacyCodec, LegacyData, Mode, RawGps, Settings
from drivers.xsens_mtig.mtdata2 import Utc
from drivers.xsens_mtig.protocol import MessageDecoder, Mid

# ethz-asl/ethzasl_xsens_driver, issue 66: the data of a real MTi-G, checksum added.
REAL = (
    "FAFF32363D618499BD2559AD411D13ED3B1B5260BAC11234BB7F213FBE3A38CC3E49C10CBEA3FCDA3E8BAD87BB5302CB"
    "3BF3D3BABF7647E04B3341"
)
CALIBRATED = Mode.CALIBRATED | Mode.ORIENTATION


def test_real_message_holds_what_it_says():
    [message] = MessageDecoder().receive_data(bytes.fromhex(REAL))
    assert message.mid == Mid.MTDATA
    sample = LegacyCodec(Layout(CALIBRATED, Settings.SAMPLE_COUNTER)).decode(message.data)
    assert sample.acceleration_mps2 == pytest.approx((0.0551, -0.0404, 9.8174), abs=1e-4)
    assert sample.rate_radps == pytest.approx((0.00237, -0.00147, -0.00389), abs=1e-5)
    assert sample.magnetic_field == pytest.approx((-0.182, 0.197, -0.320), abs=1e-3)
    assert sample.orientation == pytest.approx((0.2728, -0.0032, 0.0074, -0.9620), abs=1e-4)
    assert sample.sample_counter == 19_251


def test_traces_of_an_mti_g_are_read_and_made_again(shared: Path):
    recorded = (shared / "captures/xsens/mtig_legacy_issue66_mtdata_x2.bin").read_bytes()
    codec = LegacyCodec(Layout(CALIBRATED, Settings.SAMPLE_COUNTER))
    messages = MessageDecoder().receive_data(recorded)
    decoded = [codec.decode(message.data) for message in messages]
    assert [sample.sample_counter for sample in decoded] == [19_251, 19_252]
    assert [codec.encode(sample) for sample in decoded] == [message.data for message in messages]


def test_configuration_of_a_real_mti_g_announces_the_layouts_length(shared: Path):
    recorded = (shared / "captures/xsens/mtig_legacy_issue66_configuration.bin").read_bytes()
    [message] = MessageDecoder().receive_data(recorded)
    assert (message.mid, len(message.data)) == (Mid.CONFIGURATION, 118)
    length, mode, settings = (
        int.from_bytes(message.data[a:b], "big") for a, b in ((102, 104), (104, 106), (106, 110))
    )
    assert (length, mode, settings) == (54, CALIBRATED, Settings.SAMPLE_COUNTER)
    assert Layout(mode, settings).data_bytes == length


def test_parts_stand_where_the_manual_puts_them():
    sample = LegacyData(
        raw_inertial=(1,) * 10,
        raw_gps=RawGps(2, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 3),
        temperature_c=4.0,
        acceleration_mps2=(5.0,) * 3,
        rate_radps=(6.0,) * 3,
        magnetic_field=(7.0,) * 3,
        orientation=(8.0,) * 4,
        analog=(9, 9),
        position=(10.0,) * 3,
        velocity_mps=(11.0,) * 3,
        status=12,
        sample_counter=13,
        utc=Utc(0, 2019, 2, 3, 4, 5, 6, 14),
    )
    data = LegacyCodec(Layout(KNOWN_MODE, Settings.SAMPLE_COUNTER | Settings.UTC)).encode(sample)
    parts = struct.unpack(">10H H41sB f3f3f3f4f 2H 3f3f BH 4sH5BB", data)
    assert parts[:10] == (1,) * 10
    assert (parts[10], parts[12]) == (2, 3)
    assert parts[13:27] == (4.0, *(5.0,) * 3, *(6.0,) * 3, *(7.0,) * 3, *(8.0,) * 4)
    assert parts[27:37] == (9, 9, *(10.0,) * 3, *(11.0,) * 3, 12, 13)
    assert parts[38:] == (2019, 2, 3, 4, 5, 6, 14)


def test_orientation_format_3_does_not_exist():
    with pytest.raises(ProtocolError, match="orientation format 3"):
        LegacyCodec(Layout(Mode.ORIENTATION, 0xC))


@pytest.mark.parametrize(
    ("switch", "name"),
    [
        (Settings.NO_ACCELERATION, "acceleration_mps2"),
        (Settings.NO_RATE, "rate_radps"),
        (Settings.NO_MAGNETIC_FIELD, "magnetic_field"),
    ],
)
def test_what_is_switched_off_is_neither_written_nor_read(switch: Settings, name: str):
    values = {"acceleration_mps2": (1.0,) * 3, "rate_radps": (2.0,) * 3, "magnetic_field": (3.0,) * 3}
    codec = LegacyCodec(Layout(Mode.TEMPERATURE | Mode.CALIBRATED, switch))
    data = codec.encode(LegacyData(temperature_c=4.0, **values))
    assert len(data) == 28
    assert codec.decode(data) == LegacyData(temperature_c=4.0, **{**values, name: None})


def test_data_of_another_layout_are_refused():
    codec = LegacyCodec(Layout(Mode.STATUS, Settings.SAMPLE_COUNTER))
    with pytest.raises(ProtocolError, match=r"MTData of 4 bytes, .* makes 3"):
        codec.decode(bytes(4))
    with pytest.raises(ValueError, match="sample_counter is missing"):
        codec.encode(LegacyData(status=1))
