"""The fake LUX serves third-party clients, keeps time, refuses what the real one refuses.

Order and form of the dialogues: SICKAG/libsick_ldmrs (example), MRPT CIbeoLuxETH, Ibeo SDK 6.0.4 LuxLiveDemo.
"""

import math
import struct

import numpy as np
import pytest

from drivers.ibeo_lux.messages import Command, PointFlag, ScanFlag, read_reply, read_scan, write_parameter
from drivers.ibeo_lux.protocol import DataType, Decoder, Message, encode
from service.geometry.se2 import SE2
from simulators.ibeo_lux import FakeIbeoLux, LuxSetup
from simulators.trajectory import Follow, plan_drive
from simulators.truth import IBEO_LUX, LaserTruth, Ride
from simulators.world import Plan, make_world
from tests.drivers.lux import Room
from tests.drivers.virtual_time import sent_until

SECOND_NS = 1_000_000_000
START_NS = 500 * SECOND_NS


class Client:
    """A client of a device in virtual time that sorts its messages."""

    def __init__(self, setup=None, source=None):
        self.device = FakeIbeoLux(source or Room(), setup or LuxSetup())
        self.now_ns = START_NS
        self.decoder = Decoder()
        self.received = self.decoder.receive_data(self.device.connected(self.now_ns))

    def send(self, command, body=b"", version=0):
        """The bytes of the answer."""
        payload = struct.pack("<2H", command, version) + body
        return self.device.receive_data(encode(Message(DataType.COMMAND, payload, 1)), self.now_ns)

    def ask(self, command, body=b""):
        [message] = self.decoder.receive_data(self.send(command, body))
        assert message.data_type == DataType.REPLY
        return read_reply(message.payload)

    def listen(self, seconds):
        """Messages with their times."""
        begin_ns, self.now_ns = self.now_ns, self.now_ns + round(seconds * SECOND_NS)
        sent = sent_until(self.device, begin_ns, self.now_ns)
        return [(at_ns, message) for at_ns, data in sent for message in self.decoder.receive_data(data)]

    def scans(self, seconds):
        return [
            read_scan(message.payload)
            for _, message in self.listen(seconds)
            if message.data_type == DataType.SCAN
        ]


def test_libsick_start_up_gets_replies_of_the_lengths_it_requires():
    client = Client(LuxSetup(measuring=False, unsupported=frozenset({0x1109})))
    assert len(client.send(0x0001, version=3)) == 24 + 32
    assert len(client.send(0x0011, struct.pack("<H", 0x3302), version=3)) == 24 + 8
    assert client.send(0x0011, struct.pack("<H", 0x1109), version=3)[24:] == bytes.fromhex("1180")
    assert len(client.send(0x0030, struct.pack("<HI", 0, 4_000_000_000), version=3)) == 24 + 2
    assert len(client.send(0x0031, struct.pack("<HI", 0, 0), version=3)) == 24 + 2
    values = [(0x1102, 3200), (0x1100, 1600), (0x1101, 0xF9C0)]
    values += [(index, 0) for index in range(0x1200, 0x1206)] + [(0x1012, 0xFFEE)]
    for index, value in values:
        reply = client.send(0x0010, struct.pack("<HI", index, value), version=3)
        assert reply[24:] == bytes.fromhex("1000")
    assert client.send(0x0020, version=3)[24:] == bytes.fromhex("2000")
    scans = client.scans(2.0)
    assert len(scans) == pytest.approx(21, abs=1)
    assert scans[0].start_ntp >> 32 == 4_000_000_000


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


def test_low_layers_meet_the_ground_where_the_height_is_given():
    client = Client(LuxSetup(height_m=0.3, labels=ScanFlag.GROUND_LABELLED))
    points = client.scans(0.2)[0].points
    lowest = points[points["layer_echo"] == 0]
    assert lowest["range_cm"] == pytest.approx(30 / math.sin(math.radians(1.2)), abs=0.6)
    assert (lowest["flags"] & PointFlag.GROUND).all()
    others = points[points["layer_echo"] > 0]
    assert (others["range_cm"] > 1990).all()
    assert not (others["flags"] & PointFlag.GROUND).any()


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
def test_impossible_parameters_are_refused(index, value):
    client = Client()
    reply = client.ask(Command.SET_PARAMETER, write_parameter(index, value))
    assert (reply.command, reply.refused, reply.body) == (0x0010, True, b"")


def test_unknown_short_and_internal_commands_do_no_harm():
    client = Client()
    assert client.send(0x0002)[24:] == bytes.fromhex("0280")
    assert client.send(0x0010, b"\1")[24:] == bytes.fromhex("1080")
    assert client.device.receive_data(encode(Message(DataType.COMMAND, b"\1")), client.now_ns) == b""
    assert client.device.receive_data(b"GET / HTTP/1.1\r\n\r\n", client.now_ns) == b""
    assert client.device.receive_data(encode(Message(DataType.SCAN, b"")), client.now_ns) == b""
    assert client.scans(0.5)


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
