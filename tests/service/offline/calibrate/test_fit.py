"""The fit alone, on paths without a map: poses as of lasers, with the noise of their poses."""

import math

import numpy as np
import pytest

from service.errors import InputError
from service.geometry.se2 import SE2
from service.offline.calibrate.fit import fit_gyro, fit_lasers, fit_wheels
from service.offline.calibrate.tracks import LaserTrack, gyro_track, wheel_track
from simulators.truth import Ride
from tests.service.offline.calibrate.drives import late, to_both_sides
from tests.simulated import Imu, Wheels, inertial, odometry

WORLD = to_both_sides()
SECONDS = WORLD.drive.duration_s
RIDE = Ride(WORLD, 0, 1.0)
MOUNTING = SE2(0.27, -0.08, math.radians(-171.0))
BASE_M = 0.235


def laser(mounting=MOUNTING, seed=1, late_s=0.0, ride=RIDE, sigma_m=0.002, sigma_rad=0.0005):
    """20 poses a second; stamps of 1 s and more, as `late` makes those of the others."""
    stamps = np.arange(0, round(SECONDS * 1e9), 50_000_000, dtype=np.int64)
    poses = [SE2(*row) @ mounting for row in ride.poses(stamps).tolist()]
    pose = np.array([(p.x_m, p.y_m, p.theta_rad) for p in poses])
    pose += np.random.default_rng(seed).normal(0.0, (sigma_m, sigma_m, sigma_rad), pose.shape)
    pose[:, 2] = np.unwrap(pose[:, 2])
    shifted = stamps + 10**9 + round(late_s * 1e9)
    return LaserTrack("front", shifted, pose, np.zeros(len(stamps)))


def wheels(late_s=0.0, seed=1, ride=RIDE, **errors):
    return wheel_track(late(odometry(ride, Wheels(**errors), SECONDS, seed), {"base": late_s}))


def test_mounting_scales_and_offset_are_found_within_what_is_aimed_at():
    fit = fit_wheels(laser(), wheels(scale=1.04, turn_scale=0.95, late_s=0.013), BASE_M)
    assert fit["x_m"] == pytest.approx(MOUNTING.x_m, abs=0.01)
    assert fit["y_m"] == pytest.approx(MOUNTING.y_m, abs=0.01)
    assert math.remainder(math.degrees(fit["yaw_rad"]) + 171.0, 360.0) == pytest.approx(0.0, abs=0.1)
    assert fit["scale"] == pytest.approx(1.0 / 1.04, rel=0.003)
    assert fit["turn_scale"] == pytest.approx(1.0 / 0.95, rel=0.003)
    assert fit["offset_s"] == pytest.approx(0.013, abs=0.002)
    assert fit["turn_per_m"] == pytest.approx(0.0, abs=0.003)


@pytest.mark.soak
def test_the_uncertainties_are_those_of_repeated_drives():
    """Errors of six drives in units of what each fit says of itself: it must not promise too much."""
    names = ("x_m", "y_m", "yaw_rad", "scale", "turn_scale", "offset_s")
    truth = (MOUNTING.x_m, MOUNTING.y_m, MOUNTING.theta_rad, 1.0, 1.0, 0.0)
    pulls = []
    for seed in range(1, 7):
        fit = fit_wheels(laser(seed=seed), wheels(seed=seed), BASE_M)
        off = [fit[name] - true for name, true in zip(names, truth, strict=True)]
        off[2] = math.remainder(off[2], math.tau)
        pulls.append([value / fit.sigma(name) for name, value in zip(names, off, strict=True)])
    rms = np.sqrt((np.array(pulls) ** 2).mean(axis=0))
    assert (rms < 2.0).all(), dict(zip(names, rms, strict=True))
    assert (rms > 0.1).all(), dict(zip(names, rms, strict=True))


def test_unequal_wheels_turn_the_vehicle_on_straights():
    track = wheels()
    uneven = 0.004  # left wheel counts 0.4 % too much, right one 0.4 % too little
    half = BASE_M / 2.0
    left = (track.steps[:, 0] - half * track.steps[:, 2]) / (1.0 - uneven)
    right = (track.steps[:, 0] + half * track.steps[:, 2]) / (1.0 + uneven)
    track.steps[:, 0], track.steps[:, 2] = (left + right) / 2.0, (right - left) / BASE_M
    fit = fit_wheels(laser(), track, BASE_M)
    assert fit["turn_per_m"] == pytest.approx(2.0 * uneven / BASE_M, rel=0.1)


def test_a_gyro_is_compared_by_its_turns():
    samples = late(inertial(RIDE, Imu(gyro_bias_radps=0.01), SECONDS, 3), {"imu": -0.008})
    fit = fit_gyro(laser(), gyro_track(samples))
    assert fit["scale"] == pytest.approx(1.0, abs=0.002)
    assert fit["offset_s"] == pytest.approx(-0.008, abs=0.001)
    assert abs(fit["bias_radps"]) < 0.03


def test_a_second_laser_is_placed_against_the_first():
    other = SE2(-0.31, 0.12, math.radians(30.0))
    fit = fit_lasers(laser(), laser(other, seed=2, late_s=0.021))
    expected = MOUNTING.inverse() @ other
    assert fit["x_m"] == pytest.approx(expected.x_m, abs=0.005)
    assert fit["y_m"] == pytest.approx(expected.y_m, abs=0.005)
    assert math.remainder(fit["yaw_rad"] - expected.theta_rad, math.tau) == pytest.approx(0.0, abs=0.001)
    assert fit["offset_s"] == pytest.approx(0.021, abs=0.001)


class Straight:
    """Back and forth along a line."""

    def poses(self, stamps_ns):
        along = np.sin(stamps_ns * 1e-9)
        return np.column_stack((along, np.zeros_like(along), np.zeros_like(along)))


def test_a_drive_without_turns_says_that_it_does_not_know_the_place():
    fit = fit_wheels(laser(ride=Straight()), wheels(ride=Straight()), BASE_M)
    assert math.remainder(math.degrees(fit["yaw_rad"]) + 171.0, 360.0) == pytest.approx(0.0, abs=1.0)
    assert max(fit.sigma("x_m"), fit.sigma("y_m")) > 0.05
    assert max(abs(fit["x_m"]), abs(fit["y_m"])) < 2.0


def test_sensors_that_were_hardly_awake_together_are_refused():
    track = wheels(late_s=SECONDS - 5.0)
    with pytest.raises(InputError, match="together with the sensor it is compared with; expected 16 s"):
        fit_wheels(laser(), track, BASE_M)
