"""The fake units on their own: what they answer to whom, when, and what they do when they are ill-treated."""

import math
import struct

import numpy as np
import pytest

from drivers.xsens_mtig.mtdata import Layout, LegacyCodec, Mode
from drivers.xsens_mtig.mtdata2 import (
    Kind,
    decode_items,
    read_output_configuration,
    write_output_configuration,
)
from drivers.xsens_mtig.protocol import Message, MessageDecoder, Mid, encode
from service.geometry.se2 import SE2
from simulators.device import FakeDevice, HasChecksum, HasClock, Restartable
from simulators.inertial import InertialTruth
from simulators.trajectory import Follow, plan_drive
from simulators.truth import Ride
from simulators.vehicle import FakeVehicle, parse_device, parse_devices
from simulators.world import Plan, make_world
from simulators.xsens_mtig import FakeMtiG, MtigSetup
from tests.drivers.mtig import MS, ZERO_NS, legacy, mtdata2
from tests.drivers.virtual_time import SECOND_NS

BOTH = pytest.mark.parametrize("make", [mtdata2, legacy])


class Host:
    """Says things to a unit and hears what comes, in virtual time."""

    def __init__(self, unit: FakeMtiG) -> None:
        self.unit = unit
        self.now_ns = ZERO_NS
        self.heard: list[tuple[int, Message]] = []
        self._decoder = MessageDecoder()
        unit.connected(self.now_ns)

    def wait(self, seconds: float) -> list[Message]:
        end_ns, count = self.now_ns + round(seconds * SECOND_NS), len(self.heard)
        while (due_ns := self.unit.next_due_ns(self.now_ns)) is not None and due_ns <= end_ns:
            self.now_ns = max(self.now_ns, due_ns)
            for message in self._decoder.receive_data(self.unit.due(self.now_ns)):
                self.heard.append((self.now_ns, message))
        self.now_ns = end_ns
        return [message for _, message in self.heard[count:]]

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


@BOTH
def test_it_keeps_to_what_faults_may_ask_of_a_device(make):
    unit: object = make()
    for protocol in (Restartable, HasClock, HasChecksum):
        assert isinstance(unit, protocol)
    device: FakeDevice = make()
    assert device.connected(ZERO_NS) == b""
    damaged = make().spoil_checksum(encode(Mid.WAKE_UP))
    assert MessageDecoder().receive_data(damaged) == []


@BOTH
def test_a_unit_measures_from_the_start_and_its_answer_waits_behind_data(make):
    host = Host(make())
    assert {m.mid for m in host.wait(0.5)} == {Mid.MTDATA if host.unit.settings.legacy else Mid.MTDATA2}
    host.wait(0.003 + (-host.now_ns % (10 * MS)) * 1e-9)  # a sample is on the line
    host.unit.receive_data(encode(Mid.GO_TO_CONFIG), host.now_ns)
    mids = [m.mid for m in host.wait(0.5)]
    assert mids[-1] == Mid.GO_TO_CONFIG + 1
    assert 1 <= len(mids) <= 3
    assert host.wait(1.0) == []


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


@BOTH
def test_setup_is_for_the_config_state_alone(make):
    host = Host(make())
    assert host.ask(Mid.REQ_DEVICE_ID) == refused(0x04)
    assert host.ask(Mid.RESET_ORIENTATION, "0001") == Message(Mid.RESET_ORIENTATION + 1)


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
        for item in decode_items(message.data):
            counts[item.id] = counts.get(item.id, 0) + 1
    for identifier, rate in ((0x8020, 400), (0x4020, 100), (0xC020, 100), (0x3010, 50), (0x7010, 4)):
        assert counts[identifier] == pytest.approx(rate, abs=2)
    assert counts[0x1020] == len(messages)


def test_every_item_a_unit_can_send_is_sent_and_read():
    kinds = [k for k in Kind if k not in (0x7020, 0xA010, 0xA020, 0xE090)]
    host = Host(mtdata2(baud=None)).configured()
    requested = [
        (kind | precision, 100)
        for kind in kinds
        for precision in ((2,) if kind in (0x4020, 0x2010) else (0,))
    ]
    host.ask(Mid.OUTPUT_CONFIGURATION, write_output_configuration(requested).hex())
    host.ask(Mid.GO_TO_MEASUREMENT)
    items = {item.id: item.value for m in host.wait(2.0) for item in decode_items(m.data)}
    assert set(items) == {identifier for identifier, _ in requested}
    earth_m = math.sqrt(sum(v * v for v in items[0x5030]))
    assert earth_m == pytest.approx(6.3624e6, rel=1e-3)  # of the ellipsoid at 60 deg
    assert items[0x8030][0] == pytest.approx(1.0, abs=0.01)
    assert items[0x4030] == pytest.approx((0.3 * math.cos(0.4) - 0.5 * math.sin(0.4), 0.577, 0.0), abs=1e-2)


@BOTH
def test_reset_is_acknowledged_then_silence_then_wake_up(make):
    host = Host(make())
    host.wait(0.3)
    requested_ns = host.now_ns
    host.unit.receive_data(encode(Mid.RESET), host.now_ns)
    host.wait(0.9)
    mids = [(t - requested_ns, m.mid) for t, m in host.heard if t > requested_ns]
    assert mids[-2][1] == Mid.RESET + 1
    assert mids[-1][1] == Mid.WAKE_UP
    assert mids[-1][0] == pytest.approx(800 * MS, abs=2 * MS)
    host.unit.receive_data(encode(Mid.WAKE_UP_ACK), host.now_ns)
    assert host.wait(2.0) == []
    assert host.unit.state == "config"


def test_baud_rate_counts_from_the_next_reset_on():
    host = Host(mtdata2()).configured()
    assert host.ask(Mid.BAUDRATE, "00") == Message(Mid.BAUDRATE + 1)
    assert host.unit.settings.baud == 115_200
    assert host.ask(Mid.BAUDRATE).data == b"\x00"
    host.unit.receive_data(encode(Mid.RESET), host.now_ns)
    assert host.unit.settings.baud == 460_800


def test_line_is_as_slow_as_its_baud_rate():
    host = Host(legacy(baud=115_200))
    host.wait(1.0)
    (first_ns, message), (second_ns, _) = host.heard[:2]
    assert second_ns - first_ns == 10 * MS
    sample_ns = ZERO_NS + 10 * MS
    on_the_line_ns = message.wire_bytes * 10e9 / 115_200
    assert first_ns - sample_ns == pytest.approx(1 * MS + on_the_line_ns, abs=1000)


def test_more_than_the_line_carries_overflows_and_says_so():
    unit = legacy(baud=9_600)
    host = Host(unit)
    host.wait(5.0)
    assert refused(0x1E) in [m for _, m in host.heard]
    assert unit.counters["messages_overflowed"] > 100
    assert len(host.heard) * 59 * 10 <= 5.2 * 9_600


def test_polled_legacy_unit_sends_when_asked():
    unit = legacy()
    unit.settings.write(Mid.SKIP_FACTOR, b"\xff\xff")
    host = Host(unit)
    assert host.wait(1.0) == []
    unit.receive_data(encode(Mid.REQ_DATA), host.now_ns)
    [message] = host.wait(0.1)
    codec = LegacyCodec(Layout(unit.settings.mode, unit.settings.output_settings))
    assert codec.decode(message.data).rate_radps == pytest.approx((0.1, -0.2, 1.0), abs=0.02)


def test_gnss_messages_come_45_ms_late_with_their_own_time_and_counter():
    unit = mtdata2(baud=460_800)
    unit.settings.output = [(0x1020, 0xFFFF), (0x1060, 0xFFFF), (0x8020, 200), (0x7010, 4)]
    host = Host(unit)
    host.wait(3.0)
    packets, last_ticks, late = [], 0, []
    for _, message in host.heard:
        items = {item.id: item.value for item in decode_items(message.data)}
        packets.append(items[0x1020])
        if 0x7010 in items:
            late.append(last_ticks - items[0x1060])
        else:
            last_ticks = items[0x1060]
    assert packets == list(range(packets[0], packets[0] + len(packets)))
    assert len(late) >= 11
    assert all(400 <= ticks <= 500 for ticks in late)


def test_any_bytes_are_survived():
    rng = np.random.default_rng(5)
    for make in (mtdata2, legacy):
        host = Host(make())
        for _ in range(300):
            if rng.random() < 0.5:
                noise = rng.bytes(int(rng.integers(1, 40)))
            else:
                data = rng.bytes(int(rng.integers(0, 20)))
                noise = encode(int(rng.integers(0, 256)), data)
            host.unit.receive_data(noise, host.now_ns)
            host.wait(0.01)
        host.unit.receive_data(bytes(300), host.now_ns)
        host.unit.restart(host.now_ns)
        assert Mid.WAKE_UP in [m.mid for m in host.wait(2.0)]


def test_vehicle_has_a_unit_where_its_options_say(tmp_path):
    plan = Plan()
    plan.line((-5, -5), (5, -5), (5, 5), (-5, 5), (-5, -5))
    world = make_world("room", plan, [], plan_drive(SE2(), [Follow([(3, 0)])]))
    text = f"imu=xsens_mtig:personality=legacy,baud=460800,link={tmp_path / 'imu'},satellites=false"
    with FakeVehicle(parse_devices([text]), Ride(world, 0), seed=1) as vehicle:
        assert vehicle.endpoints() == [
            {"name": "imu", "device": "xsens_mtig", "endpoint": str(tmp_path / "imu")}
        ]
        unit = vehicle.devices["imu"]
        assert isinstance(unit, FakeMtiG)
        assert isinstance(unit.source, InertialTruth)
        assert unit.settings.legacy
        assert unit.settings.baud == 460_800
        assert unit.source.place(0) is None
    with pytest.raises(ValueError, match=r"baud: .*100000 is none of"):
        parse_device("imu=xsens_mtig:baud=100000")


@pytest.mark.parametrize("personality", ["mtdata2", "legacy"])
def test_places_of_the_filter_move_from_sample_to_sample_not_from_fix_to_fix(personality):
    plan = Plan()
    plan.line((-50, -50), (50, -50), (50, 50), (-50, 50), (-50, -50))
    ride = Ride(make_world("hall", plan, [], plan_drive(SE2(), [Follow([(30, 0)])])), ZERO_NS, 0.0)
    unit = FakeMtiG(InertialTruth(ride, "imu", gnss_sigma_m=0.0), MtigSetup(personality, baud=None))
    unit.settings.output = [(Kind.LAT_LON | 0x3, 100), (Kind.VELOCITY | 0x3, 100), (Kind.GNSS_PVT, 4)]
    mode, settings = Mode.POSITION | Mode.VELOCITY, 0x1 | 2 << 8  # fixed 16.32
    unit.settings.write(Mid.OUTPUT_MODE, struct.pack(">H", mode))
    unit.settings.write(Mid.OUTPUT_SETTINGS, struct.pack(">I", settings))
    longitudes_deg, speeds_mps = [], []
    for message in Host(unit).wait(6.0):
        if message.mid == Mid.MTDATA:
            data = LegacyCodec(Layout(mode, settings)).decode(message.data)
            longitude_deg, speed_mps = data.position[1], math.hypot(*data.velocity_mps)
        else:
            items = {item.id & 0xFFF0: item.value for item in decode_items(message.data)}
            if Kind.LAT_LON not in items:
                continue
            longitude_deg, speed_mps = items[Kind.LAT_LON][1], math.hypot(*items[Kind.VELOCITY])
        if longitude_deg:
            longitudes_deg.append(longitude_deg)
            speeds_mps.append(speed_mps)
    steps_m = np.diff(longitudes_deg[200:500]) * 55_500.0
    assert len(steps_m) > 250
    assert steps_m == pytest.approx(np.array(speeds_mps[200:500])[1:] * 0.01, abs=1e-3)
    assert steps_m.min() > 0.003
