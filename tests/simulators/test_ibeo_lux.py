"""The pretended LUX serves third-party clients, keeps time, refuses what the real one refuses.

Order and form of the dialogues: SICKAG/libsick_ldmrs (example), MRPT CIbeoLuxETH, Ibeo SDK 6.0.4 LuxLiveDemo.
"""

import math
import socket
import struct
import time

import numpy as np
import pytest

from drivers.ibeo_lux.messages import (
    Command,
    DeviceStatus,
    ErrorRegisters,
    Parameter,
    PointFlag,
    ScanFlag,
    read_reply,
    read_scan,
    write_ntp_part,
    write_parameter,
)
from drivers.ibeo_lux.protocol import DataType, Decoder, Message, encode, ntp_difference_ns
from service.geometry.se2 import SE2
from simulators.ibeo_lux import LEAVES_AFTER_SWEEP_NS, FakeIbeoLux, LuxSetup
from simulators.trajectory import Follow, plan_drive
from simulators.truth import IBEO_LUX, LaserTruth, Ride
from simulators.vehicle import FakeVehicle, parse_device
from simulators.world import Plan, make_world
from tests.drivers.lux import Room

SECOND_NS = 1_000_000_000
START_NS = 500 * SECOND_NS


class Client:
    """Talks to a device in virtual time and sorts what it says."""

    def __init__(self, setup=None, source=None):
        self.device = FakeIbeoLux(source or Room(), setup or LuxSetup())
        self.now_ns = START_NS
        self.decoder = Decoder()
        self.heard = self.decoder.receive_data(self.device.connected(self.now_ns))

    def say(self, command, body=b"", version=0):
        """The bytes of the answer."""
        payload = struct.pack("<2H", command, version) + body
        return self.device.receive_data(encode(Message(DataType.COMMAND, payload, 1)), self.now_ns)

    def ask(self, command, body=b""):
        [message] = self.decoder.receive_data(self.say(command, body))
        assert message.data_type == DataType.REPLY
        return read_reply(message.payload)

    def listen(self, seconds):
        """Messages with their times."""
        end_ns, heard = self.now_ns + round(seconds * SECOND_NS), []
        while (due_ns := self.device.next_due_ns(self.now_ns)) is not None and due_ns <= end_ns:
            self.now_ns = max(self.now_ns, due_ns)
            heard += [(self.now_ns, m) for m in self.decoder.receive_data(self.device.due(self.now_ns))]
        self.now_ns = end_ns
        return heard

    def scans(self, seconds):
        return [
            read_scan(message.payload)
            for _, message in self.listen(seconds)
            if message.data_type == DataType.SCAN
        ]


def test_libsick_start_up_gets_replies_of_the_lengths_it_requires():
    client = Client(LuxSetup(measuring=False, unsupported=frozenset({0x1109})))
    assert len(client.say(0x0001, version=3)) == 24 + 32
    assert len(client.say(0x0011, struct.pack("<H", 0x3302), version=3)) == 24 + 8
    assert client.say(0x0011, struct.pack("<H", 0x1109), version=3)[24:] == bytes.fromhex("1180")
    assert len(client.say(0x0030, struct.pack("<HI", 0, 4_000_000_000), version=3)) == 24 + 2
    assert len(client.say(0x0031, struct.pack("<HI", 0, 0), version=3)) == 24 + 2
    values = [(0x1102, 3200), (0x1100, 1600), (0x1101, 0xF9C0)]
    values += [(index, 0) for index in range(0x1200, 0x1206)] + [(0x1012, 0xFFEE)]
    for index, value in values:
        reply = client.say(0x0010, struct.pack("<HI", index, value), version=3)
        assert reply[24:] == bytes.fromhex("1000")
    assert client.say(0x0020, version=3)[24:] == bytes.fromhex("2000")
    scans = client.scans(2.0)
    assert len(scans) == pytest.approx(21, abs=1)
    assert scans[0].start_ntp >> 32 == 4_000_000_000


@pytest.mark.parametrize("rate_hz", [12.5, 25.0, 50.0])
def test_scans_leave_after_their_sweep_at_the_rate_set(rate_hz):
    client = Client(LuxSetup(parameters={0x1102: round(256 * rate_hz), 0x1012: 0xFFEE}))
    heard = client.listen(4.0)
    assert len(heard) == pytest.approx(4.0 * rate_hz, abs=1)
    for k, (sent_ns, message) in enumerate(heard):
        scan = read_scan(message.payload)
        begin_ns = START_NS + round(k * 1e9 / rate_hz)
        sweep_ns = 1e9 / rate_hz * 110 / 360
        assert client.device._source.first_rays_ns[k] == begin_ns
        assert sent_ns == pytest.approx(begin_ns + sweep_ns + LEAVES_AFTER_SWEEP_NS, abs=2)
        assert ntp_difference_ns(scan.end_ntp, scan.start_ntp) == pytest.approx(sweep_ns, abs=3)
        assert abs(ntp_difference_ns(message.ntp, client.device.ntp(sent_ns))) < 2


def test_points_lie_as_in_a_recorded_scan():
    client = Client(LuxSetup(parameters={0x1101: -1600 & 0xFFFF}))
    scan = client.scans(0.2)[0]
    assert len(scan.points) == 742  # a real LD-MRS announced 740 between the same angles
    layer, angle = scan.points["layer_echo"] & 0xF, scan.points["angle_ticks"].astype(int)
    assert (np.diff(angle) <= 0).all()
    assert sorted(set(angle[layer == 0]), reverse=True)[:3] == [1600, 1584, 1568]
    assert angle[layer == 2].max() == 1112
    assert scan.status == 0x030B
    assert scan.flags & ~ScanFlag.REAR_MIRROR_SIDE == 0x0002
    cos = np.cos(np.radians((layer - 1.5) * 0.8))
    np.testing.assert_allclose(scan.points["range_cm"], 2000 / cos, atol=0.5)


def test_label_bits_are_chance_where_the_labelling_did_not_run():
    flags = Client().scans(0.2)[0].points["flags"]
    assert 0.8 < np.mean(flags & PointFlag.GROUND != 0) < 0.92
    assert (flags & 0x40).all()
    labelled = Client(LuxSetup(labels=ScanFlag.GROUND_LABELLED)).scans(0.2)[0]
    assert not (labelled.points["flags"] & PointFlag.GROUND).any()


def test_low_layers_meet_the_ground_where_the_height_is_given():
    client = Client(LuxSetup(height_m=0.3, labels=ScanFlag.GROUND_LABELLED))
    points = client.scans(0.2)[0].points
    lowest = points[points["layer_echo"] == 0]
    assert lowest["range_cm"] == pytest.approx(30 / math.sin(math.radians(1.2)), abs=0.6)
    assert (lowest["flags"] & PointFlag.GROUND).all()
    others = points[points["layer_echo"] > 0]
    assert (others["range_cm"] > 1990).all()
    assert not (others["flags"] & PointFlag.GROUND).any()


def test_drops_give_a_first_echo_before_that_of_the_wall():
    points = Client(LuxSetup(rain_share=0.3, labels=ScanFlag.RAIN_LABELLED)).scans(0.2)[0].points
    drops = points[points["flags"] & PointFlag.RAIN != 0]
    assert 0.2 < len(drops) / np.count_nonzero(points["range_cm"] > 600) < 0.4
    assert (drops["layer_echo"] >> 4 == 0).all()
    assert (drops["range_cm"] <= 500).all()
    second = points[points["layer_echo"] >> 4 == 1]
    assert len(second) == len(drops)
    assert (second["range_cm"] > 1990).all()


def test_odd_angles_silence_it():
    client = Client()
    assert client.ask(Command.SET_PARAMETER, write_parameter(0x1100, 1599)).refused is False
    assert client.scans(1.0) == []


@pytest.mark.parametrize(
    ("index", "value"),
    [
        (0x1100, 1601),
        (0x1100, -1920),
        (0x1101, 1600),
        (0x1101, -1921),
        (0x1102, 2560),
        (0x1104, 0),  # while it measures
        (0x3302, 5),
        (0x9999, 0),
    ],
)
def test_what_it_cannot_have_is_refused(index, value):
    client = Client()
    reply = client.ask(Command.SET_PARAMETER, write_parameter(index, value))
    assert (reply.command, reply.refused, reply.body) == (0x0010, True, b"")


def test_resolution_changes_while_it_stands_still_and_says_why_it_does_not():
    client = Client()

    def error():
        return client.ask(Command.GET_PARAMETER, struct.pack("<H", Parameter.FLEXRES_ERROR)).body[2]

    assert client.ask(Command.SET_PARAMETER, write_parameter(0x1104, 0)).refused
    assert error() == 0x70
    client.ask(Command.STOP)
    client.ask(Command.SET_PARAMETER, write_parameter(0x1102, 6400))
    assert client.ask(Command.SET_PARAMETER, write_parameter(0x1104, 2)).refused
    assert error() == 0x6E
    assert not client.ask(Command.SET_PARAMETER, write_parameter(0x1104, 0)).refused
    client.ask(Command.START)
    angles = sorted(set(client.scans(1.0)[0].points["angle_ticks"].tolist()))
    assert min(np.diff(angles)) == 4


def test_unknown_short_and_internal_commands_do_no_harm():
    client = Client()
    assert client.say(0x0002)[24:] == bytes.fromhex("0280")
    assert client.say(0x0010, b"\1")[24:] == bytes.fromhex("1080")
    assert client.device.receive_data(encode(Message(DataType.COMMAND, b"\1")), client.now_ns) == b""
    assert client.device.receive_data(b"GET / HTTP/1.1\r\n\r\n", client.now_ns) == b""
    assert client.device.receive_data(encode(Message(DataType.SCAN, b"")), client.now_ns) == b""
    assert client.scans(0.5)


def test_clock_counts_from_power_up_drifts_and_is_set_in_two_steps():
    client = Client(LuxSetup(clock_drift_ppm=100.0))
    client.listen(100.0)
    assert client.device.ntp(client.now_ns) / 2**32 == pytest.approx(100.01, abs=1e-6)
    fraction = client.device.ntp(client.now_ns) & 0xFFFF_FFFF
    client.ask(Command.SET_NTP_SECONDS, write_ntp_part(4_000_000_000))
    assert client.device.ntp(client.now_ns) == 4_000_000_000 << 32 | fraction
    client.ask(Command.SET_NTP_FRACTION, write_ntp_part(1 << 31))
    assert client.device.ntp(client.now_ns) == 4_000_000_000 << 32 | 1 << 31


def test_power_cut_and_jumps_show_in_its_clock():
    client = Client(LuxSetup(boot_ns=SECOND_NS))
    client.now_ns += 100 * SECOND_NS
    client.device.jump_clock(30.5)
    assert client.device.ntp(client.now_ns) == round(130.5 * 2**32)
    client.device.jump_clock(-1.0)
    assert client.device.ntp(client.now_ns) == round(129.5 * 2**32)
    client.ask(Command.SET_PARAMETER, write_parameter(0x1102, 12_800))
    client.device.restart(client.now_ns)
    assert client.say(Command.GET_STATUS) == b""
    client.now_ns += 2 * SECOND_NS
    assert client.device.ntp(client.now_ns) == 2 << 32
    assert client.device.parameter(0x1102) == 3200


def test_saved_parameters_survive_a_reset_and_others_do_not():
    client = Client(LuxSetup(boot_ns=SECOND_NS))
    client.now_ns += 2 * SECOND_NS
    client.ask(Command.SET_PARAMETER, write_parameter(0x1102, 6400))
    client.ask(Command.SAVE_CONFIG)
    client.ask(Command.SET_PARAMETER, write_parameter(0x1102, 12_800))
    assert client.say(Command.RESET) == b""
    assert client.say(Command.GET_STATUS) == b""  # deaf while it boots
    client.now_ns += 2 * SECOND_NS
    assert client.device.parameter(0x1102) == 6400
    assert client.device.ntp(client.now_ns) >> 32 == 2
    client.ask(Command.RESET_PARAMETERS)
    assert client.device.parameter(0x1102) == 3200


def test_objects_vehicle_states_and_errors_come_unless_switched_off():
    client = Client(LuxSetup(sends_vehicle_state=True))
    client.device.report(ErrorRegisters(warnings_1=0x0008), client.now_ns)
    kinds = [message.data_type for _, message in client.listen(1.0)]
    assert set(kinds) == {DataType.ERRORS, DataType.SCAN, DataType.OBJECTS, DataType.VEHICLE_STATE}
    client.ask(Command.SET_PARAMETER, write_parameter(Parameter.DATA_OUTPUT, 0xFFFF))
    client.device.report(ErrorRegisters(warnings_1=0x0008), client.now_ns)
    assert {message.data_type for _, message in client.listen(1.0)} == {DataType.VEHICLE_STATE}


def test_failed_motor_ends_the_scans_and_is_reported():
    client = Client(LuxSetup(parameters={0x1012: 0xFFEE}))
    client.listen(1.0)
    client.device.motor_failed = True
    heard = [message for _, message in client.listen(3.5)]
    assert {message.data_type for message in heard} == {DataType.ERRORS}
    assert len(heard) == 4
    assert ErrorRegisters.read(heard[0].payload).error_words == ["motor 1 fault"]
    status = DeviceStatus.read(client.ask(Command.GET_STATUS).body)
    assert status.status == 0x0300
    assert status.temperature_c == pytest.approx(31.0, abs=0.2)


def test_client_that_comes_late_gets_scans_from_then_on_and_one_that_stalls_loses_some():
    client = Client()
    client.device.disconnected(client.now_ns)
    assert client.device.next_due_ns(client.now_ns) is None
    client.now_ns += 10 * SECOND_NS
    client.device.connected(client.now_ns)
    assert client.scans(1.0)[0].number == pytest.approx(125, abs=1)
    client.now_ns += 4 * SECOND_NS
    numbers = [scan.number for scan in client.scans(1.0)]
    assert numbers == list(range(numbers[0], numbers[0] + 13))
    assert client.device.counters["turns_skipped"] == pytest.approx(4 * 12.5, abs=1)


def test_vehicle_has_one_on_a_port_where_its_layers_see_the_walls():
    plan = Plan()
    plan.line((-5, -5), (5, -5), (5, 5), (-5, 5), (-5, -5))
    world = make_world("room", plan, [], plan_drive(SE2(), [Follow([(3, 0)])]))
    specs = [parse_device("lux=ibeo_lux:sigma_m=0.0,x_m=1.0,height_m=0.05")]
    with FakeVehicle(specs, Ride(world, time.monotonic_ns(), stand_s=60.0), seed=1) as vehicle:
        [endpoint] = vehicle.endpoints()
        host, port = endpoint["endpoint"].removeprefix("tcp://").split(":")
        decoder, messages = Decoder(), []
        with socket.create_connection((host, int(port)), timeout=10.0) as link:
            while not any(message.data_type == DataType.SCAN for message in messages):
                messages += decoder.receive_data(link.recv(65_536))
    points = read_scan(next(m for m in messages if m.data_type == DataType.SCAN).payload).points
    ahead = points[np.abs(points["angle_ticks"]) < 320]
    upper, lowest = ahead[ahead["layer_echo"] > 1], ahead[ahead["layer_echo"] == 0]
    np.testing.assert_allclose(upper["range_cm"] * np.cos(upper["angle_ticks"] * math.pi / 5760), 400, atol=3)
    assert lowest["range_cm"].max() == 239  # ground, before the wall


def test_each_layer_has_noise_of_its_own():
    """Both layers of a shot meet the same wall; their ranges differ as two measurements do."""
    plan = Plan()
    plan.line((-30, -30), (30, -30), (30, 30), (-30, 30), (-30, -30))
    world = make_world("hall", plan, [], plan_drive(SE2(), [Follow([(3, 0)])]))
    source = LaserTruth(Ride(world, START_NS, 0.0), "lux", SE2(), IBEO_LUX, 1)
    points = Client(source=source).scans(0.2)[0].points
    layer, range_m = points["layer_echo"] & 0x0F, points["range_cm"] / 100.0
    by_layer = [
        dict(zip(points["angle_ticks"][layer == k], range_m[layer == k], strict=True)) for k in (1, 2)
    ]
    assert not by_layer[0].keys() & by_layer[1].keys()  # shots go to the pairs by turns
    lower, upper = (
        dict(zip(points["angle_ticks"][layer == k], range_m[layer == k], strict=True)) for k in (2, 3)
    )
    both = sorted(lower.keys() & upper.keys())
    elevation = np.radians([0.4, 1.2])
    apart_m = np.array([upper[a] * np.cos(elevation[1]) - lower[a] * np.cos(elevation[0]) for a in both])
    assert len(both) > 150
    assert apart_m.std() == pytest.approx(math.sqrt(2.0) * IBEO_LUX.sigma_m, rel=0.25)
