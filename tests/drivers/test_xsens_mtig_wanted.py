import pytest

from drivers.errors import DeviceError
from drivers.xsens_mtig.mtdata import Layout, Mode
from drivers.xsens_mtig.mtdata2 import EVERY_MESSAGE, Kind
from drivers.xsens_mtig.reals import Precision
from drivers.xsens_mtig.wanted import PERIOD_HZ, PERIODS, line_bits_per_s, wanted_items, wanted_layout
from tests.drivers.mtig import config


def ids(items: list[tuple[int, int]]) -> list[int]:
    return [identifier for identifier, _ in items]


def test_a_slow_line_gets_what_matters_and_a_fast_one_gets_all():
    slow, fast, usb = (wanted_items(config(), baud) for baud in (115_200, 460_800, None))
    assert ids(slow) == [0x1020, 0x1060, 0x4020, 0x7010, 0x8020, 0xE010]
    assert line_bits_per_s(slow) <= 0.95 * 115_200
    assert ids(fast) == ids(usb) == [0x1020, 0x1060, 0x2010, 0x4020, 0x7010, 0x8020, 0xE020]
    assert dict(fast)[Kind.RATE] == 200
    assert dict(fast)[Kind.GNSS_PVT] == 4
    assert dict(fast)[Kind.STATUS_WORD] == EVERY_MESSAGE


def test_number_format_and_switches_are_obeyed():
    items = wanted_items(config(number_format="fp16.32", gnss=False, orientation=True, rate_hz=100), None)
    assert ids(items) == [0x1020, 0x1060, 0x2012, 0x4022, 0x8022, 0xE020]
    assert 0x2010 not in ids(wanted_items(config(orientation=False), None))


def test_more_than_the_line_carries_is_refused_with_numbers():
    with pytest.raises(
        DeviceError, match=r"makes 14\d\.\d kbit/s, the line at 115200 baud.*store_baud: 460800"
    ):
        wanted_items(config(orientation=True), 115_200)
    with pytest.raises(DeviceError, match="the line at 57600 baud"):
        wanted_layout(config(orientation=True), 57_600)


@pytest.mark.parametrize("rate_hz", [10, 20, 25, 40, 50, 80, 100, 200, 400])
def test_every_rate_is_a_period_and_a_skip_of_the_legacy_unit(rate_hz: int):
    output = wanted_layout(config(rate_hz=rate_hz), None)
    assert output.period in PERIODS
    assert output.period * (output.skip + 1) * rate_hz == PERIOD_HZ
    assert output.rate_hz == rate_hz


def test_legacy_layout_grows_with_the_line():
    slow, middle, fast = (wanted_layout(config(), baud) for baud in (115_200, 230_400, 460_800))
    assert slow.layout.mode == Mode.CALIBRATED | Mode.STATUS | Mode.POSITION
    assert middle.layout.mode == Mode.CALIBRATED | Mode.STATUS | Mode.RAW_GPS | Mode.ORIENTATION
    assert fast == middle
    assert slow.layout.settings == 0x0000_0C41  # counter, no magnetic field, no analog inputs, X North Z up
    fixed = wanted_layout(config(number_format="fp16.32", gnss=False), 460_800)
    assert fixed.layout.precision is Precision.FP1632
    assert fixed.layout == Layout(0x0806, 0x0000_0E41)
    with pytest.raises(DeviceError, match="no number_format float64"):
        wanted_layout(config(number_format="float64"), None)
