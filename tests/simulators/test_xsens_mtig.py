"""The fake units on their own: answers, their times, and refusals."""

import pytest

from drivers.xsens_mtig.mtdata2 import read_output_configuration, split, write_output_configuration
from drivers.xsens_mtig.protocol import Message, MessageDecoder, Mid, encode
from simulators.xsens_mtig import FakeMtiG
from tests.drivers.mtig import ZERO_NS, legacy, mtdata2
from tests.drivers.virtual_time import SECOND_NS, sent_until

BOTH = pytest.mark.parametrize("make", [mtdata2, legacy])


class Host:
    """A client of a unit in virtual time."""

    def __init__(self, unit: FakeMtiG) -> None:
        self.unit = unit
        self.now_ns = ZERO_NS
        self.received: list[Message] = []
        self._decoder = MessageDecoder()
        unit.connected(self.now_ns)

    def wait(self, seconds: float) -> list[Message]:
        begin_ns, self.now_ns = self.now_ns, self.now_ns + round(seconds * SECOND_NS)
        sent = sent_until(self.unit, begin_ns, self.now_ns)
        messages = [message for _, data in sent for message in self._decoder.receive_data(data)]
        self.received += messages
        return messages

    def ask(self, mid: int, data: str = "", bus_id: int = 0xFF) -> Message:
        """The first message back that is no data."""
        self.unit.receive_data(encode(mid, bytes.fromhex(data), bus_id), self.now_ns)
        answers = [m for m in self.wait(0.2) if m.mid not in (Mid.MTDATA, Mid.MTDATA2)]
        assert len(answers) == 1, answers
        return answers[0]

    def configured(self) -> "Host":
        assert self.ask(Mid.GO_TO_CONFIG) == Message(Mid.GO_TO_CONFIG + 1)
        return self


def refused(code: int) -> Message:
    return Message(Mid.ERROR, bytes((code,)))


# Requests of mtdevice.py -i, ethz-asl/ethzasl_xsens_driver, in its order; 4: a real MTi-G does not know them.
QUESTIONS = [
    (Mid.REQ_CONFIGURATION, "", 118, 118),
    (Mid.REQ_DEVICE_ID, "", 4, 4),
    (Mid.REQ_PRODUCT_CODE, "", 14, 20),
    (Mid.REQ_HARDWARE_VERSION, "", None, 2),
    (Mid.REQ_FIRMWARE, "", 3, 11),
    (Mid.BAUDRATE, "", 1, 1),
    (Mid.ERROR_MODE, "", 2, 2),
    (Mid.OPTION_FLAGS, "", None, 4),
    (Mid.LOCATION_ID, "", 2, 2),
    (Mid.TRANSMIT_DELAY, "", None, 2),
    (Mid.SYNC_SETTINGS, "", None, 0),
    (Mid.OUTPUT_CONFIGURATION, "", None, 28),
    (Mid.STRING_OUTPUT, "", None, 2),
    (Mid.PERIOD, "", 2, 2),
    (Mid.ALIGNMENT_ROTATION, "00", None, 17),
    (Mid.ALIGNMENT_ROTATION, "01", None, 17),
    (Mid.OUTPUT_MODE, "", 2, 2),
    (Mid.EXT_OUTPUT_MODE, "", 2, None),
    (Mid.OUTPUT_SETTINGS, "", 4, 4),
    (Mid.LAT_LON_ALT, "", None, 24),
    (Mid.GNSS_PLATFORM, "", None, 2),
    (Mid.REQ_SCENARIOS, "", 110, 110),
    (Mid.SCENARIO, "", 2, 2),
    (Mid.UTC_TIME, "", 12, 12),
    (Mid.REQ_DATA_LENGTH, "", 2, 2),
    (Mid.RUN_SELFTEST, "", 2, 2),
    (Mid.LEVER_ARM, "", 12, 12),
    (Mid.MAGNETIC_DECLINATION, "", 4, 4),
    (Mid.GPS_STATUS, "", 81, None),
    (Mid.SYNC_OUT, "00", 2, None),
    (0x7C, "", None, None),
]


@BOTH
def test_every_question_is_answered_or_refused_as_the_real_ones_do(make):
    host = Host(make()).configured()
    for mid, data, old, new in QUESTIONS:
        answer, size = host.ask(mid, data), old if host.unit.settings.legacy else new
        if size is None:
            assert answer == refused(0x04), hex(mid)
        else:
            assert (answer.mid, len(answer.data)) == (mid + 1, size), hex(mid)


def test_configuration_of_the_legacy_unit_has_the_real_ones_form(shared):
    recorded = (shared / "captures/xsens/mtig_legacy_issue66_configuration.bin").read_bytes()
    [real] = MessageDecoder().receive_data(recorded)
    assert Host(legacy()).configured().ask(Mid.REQ_CONFIGURATION).data == real.data


@pytest.mark.parametrize(
    ("mid", "data", "code"),
    [
        (Mid.PERIOD, "0001", 0x03),
        (Mid.PERIOD, "04", 0x21),
        (Mid.BAUDRATE, "77", 0x20),
        (Mid.OUTPUT_SETTINGS, "00000301", 0x21),
        (Mid.OUTPUT_SETTINGS, "00000C01", None),
        (Mid.SCENARIO, "0063", 0x21),
        (Mid.OPTION_FLAGS, "00", 0x21),
        (Mid.ALIGNMENT_ROTATION, "02", 0x21),
        (Mid.OUTPUT_CONFIGURATION, "8020", 0x21),
        (Mid.OUTPUT_CONFIGURATION, "99990064", 0x21),
        (Mid.OUTPUT_CONFIGURATION, "80200190" * 33, 0x21),
        (Mid.OUTPUT_CONFIGURATION, "2010019040200190802001904030019050420190", 0x29),
    ],
)
def test_settings_that_cannot_be_are_refused_with_the_manuals_codes(mid, data, code):
    answer = Host(mtdata2()).configured().ask(mid, data)
    assert answer == (Message(mid + 1) if code is None else refused(code))


def test_effective_rates_come_back_and_stay():
    host = Host(mtdata2(baud=921_600)).configured()
    requested = [(0x1020, 100), (0x8020, 0), (0x4020, 150), (0xC020, 400), (0x3010, 0xFFFF), (0x7010, 10)]
    answer = host.ask(Mid.OUTPUT_CONFIGURATION, write_output_configuration(requested).hex())
    effective = [(0x1020, 0xFFFF), (0x8020, 400), (0x4020, 100), (0xC020, 100), (0x3010, 50), (0x7010, 4)]
    assert read_output_configuration(answer.data) == effective
    assert host.ask(Mid.OUTPUT_CONFIGURATION).data == answer.data
    host.ask(Mid.GO_TO_MEASUREMENT)
    messages = host.wait(1.0)
    counts = {}
    for message in messages:
        for identifier, _ in split(message.data):
            counts[identifier] = counts.get(identifier, 0) + 1
    for identifier, rate in ((0x8020, 400), (0x4020, 100), (0xC020, 100), (0x3010, 50), (0x7010, 4)):
        assert counts[identifier] == pytest.approx(rate, abs=2)
    assert counts[0x1020] == len(messages)


def test_more_than_the_line_carries_overflows_and_is_reported():
    unit = legacy(baud=9_600)
    host = Host(unit)
    host.wait(5.0)
    assert refused(0x1E) in host.received
    assert unit.counters["messages_overflowed"] > 100
    assert len(host.received) * 59 * 10 <= 5.2 * 9_600
