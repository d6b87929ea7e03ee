"""Motion of people, trains and the visible floor with the vehicle, and slip of the wheels."""

import math
from dataclasses import replace

import numpy as np
import pytest

from service.geometry.se2 import SE2
from simulators.device import Beams
from simulators.disturbances import Knock, Slip
from simulators.trajectory import Follow, Limits, Pause, plan_drive
from simulators.truth import LMS100, LaserTruth, Ride, WheelModel, WheelTruth
from simulators.world import Plan, World, make_world
from tests.moving_things import beside, with_companions, with_floor_seen, with_train

PERFECT = replace(LMS100, sigma_m=0.0, quantum_m=1e-6, mixed_share=0.0, dropout_share=0.0, tenth_range_m=1e3)
FROM_S, TO_S = 4.0, 9.0
MIDDLE_S = 6.5


@pytest.fixture
def world() -> World:
    """A hall of 36 x 20 m, driven along its middle at 1 m/s and round a corner."""
    plan = Plan()
    plan.line((-18, -10), (18, -10), (18, 10), (-18, 10), (-18, -10), reflectivity=0.9)
    drive = plan_drive(SE2(), [Follow([(8, 0), (8, 8)]), Pause(1.0)], Limits(acceleration_mps2=1.0))
    return make_world("hall", plan, [], drive)


def range_m(world: World, time_s: float, angle_deg: float, *knocks: Knock, sensor: str = "front") -> float:
    source = LaserTruth(Ride(world, 0, 0.0), sensor, SE2(), PERFECT, 1, knocks)
    ranges = source.sweep(Beams(round(time_s * 1e9), 1, math.radians(angle_deg), 0.0, 3)).range_m
    return float(ranges[0])


def base_at(world: World, time_s: float) -> SE2:
    return SE2(*world.drive.poses(np.array([time_s]))[0].tolist())


def test_companions_keep_their_place_beside_the_path_of_the_vehicle(world: World) -> None:
    people = with_companions(world, beside(2, 0.8), FROM_S, TO_S, sway_m=0.0).people
    for time_s in (FROM_S, MIDDLE_S):
        seen = [base_at(world, time_s).inverse() @ SE2(*person.place(time_s), 0.0) for person in people]
        np.testing.assert_allclose([(s.x_m, s.y_m) for s in seen], [(0.9, 0.8), (0.9, -0.8)], atol=0.01)


def test_companions_are_seen_only_for_their_time(world: World) -> None:
    escorted = with_companions(world, beside(1, 0.8), FROM_S, TO_S, sway_m=0.0)
    at_side_deg = math.degrees(math.atan2(0.8, 0.9))
    assert range_m(escorted, MIDDLE_S, at_side_deg) == pytest.approx(math.hypot(0.9, 0.8) - 0.25, abs=0.01)
    for time_s in (FROM_S - 0.1, TO_S + 0.1):
        assert range_m(escorted, time_s, at_side_deg) > 3.0
    staying = with_companions(world, beside(1, 0.8), FROM_S, TO_S, stay=True).people[0]
    assert staying.place(TO_S + 50.0) == pytest.approx(staying.place(TO_S))


def test_train_goes_along_or_passes(world: World) -> None:
    along = with_train(world, FROM_S, TO_S, left_m=1.5, length_m=4.0)
    assert [range_m(along, t, 90.0) for t in (FROM_S + 0.1, MIDDLE_S)] == pytest.approx([1.5, 1.5], abs=0.01)
    assert range_m(along, FROM_S - 0.1, 90.0) == pytest.approx(10.0, abs=0.01)
    passing = with_train(world, FROM_S, TO_S, left_m=1.5, length_m=4.0, speed_mps=3.0)
    assert range_m(passing, MIDDLE_S, 90.0) == pytest.approx(1.5, abs=0.01)
    assert range_m(passing, FROM_S + 0.1, 90.0) > 9.0


def test_floor_stays_ahead_of_the_laser_that_sees_it_and_hides_what_is_behind(world: World) -> None:
    floored = with_floor_seen(world, "front", SE2(), 2.6, FROM_S, TO_S)
    for time_s in (FROM_S + 0.1, MIDDLE_S, TO_S - 0.5):
        assert range_m(floored, time_s, 0.0) == pytest.approx(2.6, abs=0.01)
        assert range_m(floored, time_s, 30.0) == pytest.approx(2.6 / math.cos(math.radians(30.0)), abs=0.01)
        assert range_m(floored, time_s, 0.0, sensor="rear") > 3.0
    assert range_m(floored, TO_S + 0.1, 0.0) > 3.0


def test_knocked_laser_looks_elsewhere_for_its_time(world: World) -> None:
    knock = Knock(FROM_S, TO_S, math.radians(40.0))
    assert range_m(world, FROM_S + 0.1, 10.0, knock) == pytest.approx(range_m(world, FROM_S + 0.1, 50.0))
    assert range_m(world, TO_S + 0.1, 10.0, knock) == pytest.approx(range_m(world, TO_S + 0.1, 10.0))


def test_wheels_slip_for_their_time(world: World) -> None:
    exact = WheelModel(scale_sigma=0.0, slip_sigma_m=0.0, slips_per_m=0.0)
    ride = Ride(world, 0, 0.0)
    frozen = WheelTruth(ride, "base", replace(exact, slips=(Slip(2.0, 5.0),)), 1)
    spinning = WheelTruth(ride, "base", replace(exact, slips=(Slip(2.0, 5.0, 1.5),)), 1)
    true_m = world.drive.travel(np.array([1.5, 2.0, 5.0, 6.0]))[:, 0]
    path_length_m = true_m[2] - true_m[1]

    def distance_m(wheels: WheelTruth, time_s: float) -> float:
        return sum(wheels.wheel_travel_m(round(time_s * 1e9))) / 2.0

    assert distance_m(frozen, 1.5) == pytest.approx(true_m[0])
    assert distance_m(frozen, 3.0) == pytest.approx(true_m[1])
    assert distance_m(frozen, 6.0) == pytest.approx(true_m[3] - path_length_m)
    assert distance_m(spinning, 6.0) == pytest.approx(true_m[3] + 0.5 * path_length_m)
