import itertools
import math

import numpy as np
import pytest

from drivers.errors import TransportError
from drivers.irobot_create.create1 import QUERY_IDS, Create1Session
from drivers.irobot_create.protocol import PacketId, encode_values
from simulators.irobot_create import FakeCreate
from tests.drivers.irobot_bench import (
    CREATE1,
    MS,
    STANDING,
    Bench,
    Curve,
    S,
    bench,
    errors_m_rad,
    largest_step_m,
)


def test_create_1_keeps_the_turn_that_its_degrees_lose():
    wheels = Curve(0.2, 0.15, base_m=0.258)
    table = bench(wheels, CREATE1)
    samples = table.run(60.0)
    assert isinstance(table.session, Create1Session)
    assert 590 < len(samples) <= 600
    position_m, heading_rad = errors_m_rad(wheels, samples)
    assert heading_rad < math.radians(2.0)
    assert position_m < 0.15  # of 12 m
    truncated_deg = 0.0
    for a, b in itertools.pairwise(samples):
        turned_deg = math.degrees(wheels.motion(b.stamp_ns / S)[1] - wheels.motion(a.stamp_ns / S)[1])
        truncated_deg += abs(turned_deg) - abs(int(turned_deg))
    assert truncated_deg > 90.0  # what would be lost without the requested speeds
    assert table.session.status == "polling; battery 84 % (13.9 V, not charging), mode passive"


def test_create_1_survives_lost_and_damaged_answers():
    rng = np.random.default_rng(2)
    wheels = Curve(0.2, 0.1, base_m=0.258)
    robot = FakeCreate(wheels, "create1")
    session = Create1Session(CREATE1)
    listen = robot.receive_data

    def spoiled(data: bytes, now_ns: int) -> bytes:
        answer = bytearray(listen(data, now_ns))
        if answer and rng.random() < 0.1:
            del answer[int(rng.integers(len(answer)))]
        return bytes(answer)

    robot.receive_data = spoiled  # type: ignore[method-assign]
    samples = Bench(robot, session).run(30.0)
    assert session.counters["answers_missed"] > 10
    assert len(samples) > 150
    assert largest_step_m(samples) < 0.1
    assert all(b.stamp_ns > a.stamp_ns for a, b in itertools.pairwise(samples))


@pytest.mark.parametrize(
    "contradiction",
    [
        {PacketId.VOLTAGE: 255},
        {PacketId.CHARGING_STATE: 9},
        {PacketId.CLIFF_LEFT: 2},
        {PacketId.BUMPS_WHEEL_DROPS: 128},
        {PacketId.ANGLE: 2000},
        {PacketId.DISTANCE: -9000},
        {PacketId.REQUESTED_LEFT_VELOCITY: 501},
        {},
    ],
)
def test_create_1_refuses_an_answer_that_contradicts_itself(contradiction: dict[int, int]):
    table = bench(STANDING, CREATE1)
    before = table.run(1.05)[-1]
    good = {PacketId.VOLTAGE: 14_000, PacketId.OI_MODE: 1}
    answer = bytearray(encode_values(QUERY_IDS, good | contradiction))
    if not contradiction:
        answer[-1] = 2  # the mode at the one end is not that of the other
    table.session.tick(table.now_ns + 100 * MS)
    assert table.session.receive_data(bytes(answer), table.now_ns + 110 * MS) == []
    assert table.session.counters["answers_refused"] == 1
    after = table.run(2.0)
    assert largest_step_m([before, *after]) < 1e-3
    assert after[0].covariance[0] > before.covariance[0]


def test_create_1_that_falls_asleep_is_not_taken_for_a_wrong_baud_rate():
    table = bench(STANDING, CREATE1)
    assert table.run(3.0)
    table.robot.asleep = True
    with pytest.raises(
        TransportError, match=r"no valid answer for 8 s after \d\d; fell asleep, .*power button"
    ):
        table.run(12.0)


def test_create_1_after_a_battery_change_is_started_again():
    wheels = Curve(0.2, 0.0, 0.258)
    table = bench(wheels, CREATE1)
    before = table.run(3.0)[-1]
    table.robot.reset(table.now_ns)
    samples = table.run(5.0)
    assert len(samples) > 25
    assert table.session.identity["firmware"].startswith("3.3.0")
    assert table.session.counters["robot_resets"] == 1
    assert errors_m_rad(wheels, [before, *samples])[0] < 0.03  # what the robot forgot of a tenth of a second
    assert (
        samples[0].covariance[0] - before.covariance[0] > 0.1
    )  # its pose is known, but it may have lost more
