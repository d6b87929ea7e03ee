import math
from dataclasses import replace

import numpy as np
import pytest

from service.geometry.se2 import SE2
from simulators.device import Beams, Sweep
from simulators.trajectory import Follow, Limits, Pause, Spin, plan_drive
from simulators.truth import LMS100, LaserModel, LaserTruth, Ride, WheelModel, WheelTruth
from simulators.world import Plan, World, make_world, walk

PERFECT = replace(LMS100, sigma_m=0.0, quantum_m=1e-6, mixed_share=0.0, dropout_share=0.0, tenth_range_m=1e3)
START_NS = 7_000_000_000
BEAM_NS = 27_778
FIRST_RAD, STEP_RAD, BEAMS = -math.pi / 4, math.pi / 360, 181


def room(legs=(), people=(), limits: Limits | None = None, plan: Plan | None = None) -> World:
    """A square of 10 x 10 m around the start."""
    if plan is None:
        plan = Plan()
        plan.line((-5, -5), (5, -5), (5, 5), (-5, 5), (-5, -5), reflectivity=0.9)
    return make_world("room", plan, people, plan_drive(SE2(), legs or [Pause(1.0)], limits))


def laser(
    world: World,
    model: LaserModel = PERFECT,
    seed: int = 1,
    sensor: str = "front",
    mounting: SE2 | None = None,
):
    return LaserTruth(Ride(world, START_NS, stand_s=0.0), sensor, mounting or SE2(), model, seed)


def sweep_at(source: LaserTruth, time_s: float) -> Sweep:
    return source.sweep(Beams(START_NS + round(time_s * 1e9), BEAM_NS, FIRST_RAD, STEP_RAD, BEAMS))


def test_spinning_vehicle_measures_the_wall_bent_as_by_the_formula():
    limits = Limits(turn_rate_radps=2.0, turn_acceleration_radps2=100.0)
    source = laser(room([Spin(3.0)], limits=limits))
    range_m = sweep_at(source, 0.2).range_m
    turned_rad = (
        2.0 * (0.2 - 0.01) + 2.0 * np.arange(BEAMS) * BEAM_NS * 1e-9
    )  # half of the ramp of 0.02 s is lost
    angle_rad = turned_rad + FIRST_RAD + np.arange(BEAMS) * STEP_RAD
    expected_m = 5.0 / np.maximum(np.abs(np.cos(angle_rad)), np.abs(np.sin(angle_rad)))
    np.testing.assert_allclose(range_m, expected_m, atol=1e-5)
    frozen_m = 5.0 / np.cos(turned_rad[0] + FIRST_RAD + np.arange(BEAMS) * STEP_RAD)
    assert np.abs(range_m - frozen_m).max() > 0.02  # there is a distortion


def test_driving_vehicle_nears_the_wall_from_beam_to_beam():
    source = laser(
        room([Follow([(3, 0)])], limits=Limits(acceleration_mps2=0.5)), mounting=SE2(0.2, 0.1, 0.0)
    )
    ahead = source.sweep(Beams(START_NS + 10**9, 10**6, 0.0, 0.0, 50)).range_m
    time_s = 1.0 + np.arange(50) * 1e-3
    np.testing.assert_allclose(ahead, 5.0 - 0.2 - 0.25 * time_s**2, atol=1e-3)


def test_person_walks_on_during_a_sweep():
    stroll = walk([(3.0, -2.0), (3.0, 2.0)], 20.0, speed_mps=1.0, pause_s=0.0)
    source = laser(room(people=[stroll]))
    side = source.sweep(Beams(START_NS + 1_999_000_000, 10**6, 0.0, 0.0, 3))
    np.testing.assert_allclose(side.range_m, 2.75, atol=1e-4)
    gone = source.sweep(Beams(START_NS + 3 * 10**9, 10**6, 0.0, 0.0, 3))
    np.testing.assert_allclose(gone.range_m, 5.0, atol=1e-4)


def test_glass_returns_at_a_right_angle_and_the_wall_behind_it_elsewhere():
    plan = Plan()
    plan.line((-5, -5), (5, -5), (5, 5), (-5, 5), (-5, -5), reflectivity=0.9)
    plan.line((3, -5), (3, 5), glass=True)
    source = laser(room(plan=plan))
    degrees = np.array([0.0, 5.0, 15.0, -30.0])
    seen_m = [float(source.sweep(Beams(START_NS, 0, math.radians(a), 0.0, 1)).range_m[0]) for a in degrees]
    through_m = np.where(np.abs(degrees) < 10.0, 3.0, 5.0) / np.cos(np.radians(degrees))
    np.testing.assert_allclose(seen_m, through_m, atol=1e-4)


def test_most_beams_on_a_glass_cabinet_are_lost_and_many_come_from_behind():  # B28
    plan = Plan()
    plan.line((3, -5), (3, 5), cabinet=True, reflectivity=0.9)
    source = laser(room(plan=plan))
    range_m = np.array([source.sweep(Beams(START_NS + k, 0, 0.0, 0.0, 100)).range_m for k in range(100)])
    assert np.isnan(range_m).mean() == pytest.approx(0.7, abs=0.02)
    behind = range_m > 3.05
    assert behind.mean() == pytest.approx(0.2, abs=0.02)
    assert range_m[behind].min() > 3.09
    assert range_m[behind].max() < 4.01
    assert (np.abs(range_m - 3.0) < 0.01).mean() == pytest.approx(0.1, abs=0.02)


def test_noise_has_the_spread_the_bias_and_the_steps_of_the_model():
    model = replace(LMS100, bias_m=0.03, mixed_share=0.0, dropout_share=0.01)
    source = laser(room(), model)
    true_m = sweep_at(laser(room()), 0.0).range_m
    error_m = np.array([sweep_at(source, k * 0.02).range_m - true_m for k in range(100)])
    assert np.nanmean(error_m) == pytest.approx(0.03, abs=0.0005)
    assert np.nanstd(error_m) == pytest.approx(0.012, rel=0.02)
    assert np.isnan(error_m).mean() == pytest.approx(0.01, rel=0.2)
    millimetres = sweep_at(source, 0.0).range_m.astype(float) * 1000
    np.testing.assert_allclose(millimetres, np.round(millimetres), atol=1e-2)


def test_sweep_depends_on_seed_sensor_and_moment_alone():
    one, other = laser(room(), LMS100), laser(room(), LMS100)
    early, late = sweep_at(one, 1.0), sweep_at(one, 2.0)
    assert sweep_at(other, 2.0).range_m.tobytes() == late.range_m.tobytes()  # asked in another order
    again = sweep_at(other, 1.0)
    assert again.range_m.tobytes() == early.range_m.tobytes()
    assert again.intensity.tobytes() == early.intensity.tobytes()
    for changed in (laser(room(), LMS100, seed=2), laser(room(), LMS100, sensor="rear")):
        assert sweep_at(changed, 1.0).range_m.tobytes() != early.range_m.tobytes()
    assert early.range_m.tobytes() != late.range_m.tobytes()


def test_share_of_the_beams_at_an_edge_returns_from_between():
    plan = Plan()
    plan.line((3, -9), (3, 9), reflectivity=0.9)
    plan.line((2, -0.5), (2, 0.5), reflectivity=0.9)
    plan.line((-9, 9), (-9, -9))
    mixing = laser(room(plan=plan), replace(PERFECT, mixed_share=0.4))
    clean = laser(room(plan=plan))
    between = {mixing: [], clean: []}
    for source, shares in between.items():
        for k in range(200):
            x = sweep_at(source, k * 0.02).range_m * np.cos(FIRST_RAD + np.arange(BEAMS) * STEP_RAD)
            shares.append(((x > 2.1) & (x < 2.9)).sum())
    assert sum(between[clean]) == 0
    # 15 mrad straddle an edge over 80 % of their width: 1.4 beams of 8.7 mrad an edge, two edges
    assert np.mean(between[mixing]) == pytest.approx(0.4 * 2 * 0.8 * 0.015 / STEP_RAD * 0.8, rel=0.35)


def test_dark_grazing_and_far_walls_give_no_return():
    plan = Plan()
    plan.line((15, -2), (15, -1), reflectivity=0.03)  # dark
    plan.line((15, 1), (15, 2), reflectivity=0.9)
    plan.line((21, -0.5), (21, 0.5), reflectivity=0.9)  # far
    plan.line((0.5, 3), (19.5, 3.1), reflectivity=0.5)  # grazing at its far end
    source = laser(room(plan=plan), LMS100)
    aims = [math.atan2(-1.5, 15), math.atan2(1.5, 15), 0.0, math.atan2(3.1, 19.3), math.atan2(3, 2)]
    range_m = np.array([source.sweep(Beams(START_NS, BEAM_NS, aim, 0.0, 20)).range_m for aim in aims])
    assert np.isnan(range_m).all(axis=1).tolist() == [True, False, True, True, False]
    assert (source.sweep(Beams(START_NS, BEAM_NS, aims[0], 0.0, 20)).intensity == 0).all()


def test_wheel_error_has_the_scale_and_spread_of_the_model():
    ride = Ride(room([Follow([(4, 0)])]), START_NS, stand_s=0.0)
    model = WheelModel(scale_sigma=0.01, slip_sigma_m=0.003, slips_per_m=0.0)
    ends = [
        WheelTruth(ride, "base", model, seed).wheel_travel_m(START_NS + 30 * 10**9) for seed in range(400)
    ]
    errors_m = np.array(ends) - 4.0
    assert np.abs(errors_m.mean(axis=0)).max() < 0.006
    assert errors_m.std() == pytest.approx(math.hypot(4.0 * 0.01, 0.003 * math.sqrt(4.0)), rel=0.1)


def test_slip_events_come_as_often_as_in_the_model():
    ride = Ride(room([Follow([(4, 0)])]), START_NS, stand_s=0.0)
    model = WheelModel(scale_sigma=0.0, slip_sigma_m=0.0, slips_per_m=0.1, slip_m=(0.01, 0.02))
    ends = [
        WheelTruth(ride, "base", model, seed).wheel_travel_m(START_NS + 30 * 10**9) for seed in range(400)
    ]
    extra_m = np.array(ends) - 4.0
    assert extra_m.min() > -1e-6
    assert extra_m.mean() == pytest.approx(4.0 * 0.1 * 0.015, rel=0.15)
