"""The inertial truth against its drive: integrals, lever arms, gravity, errors, places."""

import math

import numpy as np
import pytest

from service.geometry.se2 import SE2
from simulators.inertial import MTI_G, PERFECT_IMU, Datum, ImuMounting, InertialTruth
from simulators.trajectory import Follow, Pause, Spin, plan_drive
from simulators.truth import Ride
from simulators.world import Plan, World, make_world

START_NS = 7_000_000_000
STEP_NS = 5_000_000


@pytest.fixture(scope="module")
def world() -> World:
    plan = Plan()
    plan.line((-9, -9), (9, -9), (9, 9), (-9, 9), (-9, -9))
    legs = [Pause(1.0), Spin(1.0), Follow([(3, 4.0), (5.0, 0.0), (1.0, -3.0)]), Pause(1.0)]
    return make_world("room", plan, [], plan_drive(SE2(), legs))


def truth(world: World, model=PERFECT_IMU, **changes) -> InertialTruth:
    return InertialTruth(Ride(world, START_NS, stand_s=0.0), "imu", model=model, **changes)


def stamps(world: World, seconds: float = 0.0):
    count = round((seconds or world.drive.duration_s) * 1e9 / STEP_NS)
    return START_NS + np.arange(count, dtype=np.int64) * STEP_NS


def test_rates_add_up_to_the_turn_and_forces_to_the_motion(world):
    at = stamps(world)
    measured = truth(world).inertial(at)
    dt = STEP_NS * 1e-9
    poses = Ride(world, START_NS, 0.0).poses(at)
    turned = np.unwrap(poses[:, 2])
    np.testing.assert_allclose(np.cumsum(measured.rate_radps[:, 2]) * dt, turned - turned[0], atol=0.01)
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    ax = c * measured.force_mps2[:, 0] - s * measured.force_mps2[:, 1]
    ay = s * measured.force_mps2[:, 0] + c * measured.force_mps2[:, 1]
    for acceleration, place in ((ax, poses[:, 0]), (ay, poses[:, 1])):
        travel = np.cumsum(np.cumsum(acceleration) * dt) * dt
        np.testing.assert_allclose(travel, place - place[0], atol=0.05)
    np.testing.assert_allclose(measured.force_mps2[:, 2], 9.81)
    np.testing.assert_allclose(measured.rate_radps[:, :2], 0.0)


def test_a_sensor_off_the_middle_measures_its_lever_arm(world):
    """The second derivative of the sensor's position is the acceleration that it measures."""
    at = stamps(world)
    mounting = ImuMounting(x_m=0.8, y_m=-0.5, yaw_rad=0.7)
    measured = truth(world, mounting=mounting).inertial(at)
    dense = Ride(world, START_NS, 0.0).poses(np.arange(at[0], at[-1], 1_000_000, dtype=np.int64))
    c, s = np.cos(dense[:, 2]), np.sin(dense[:, 2])
    x = dense[:, 0] + c * 0.8 + s * 0.5
    y = dense[:, 1] + s * 0.8 - c * 0.5
    smooth = np.ones(10) / 10

    def twice(place):
        speed = np.convolve(np.gradient(place, 1e-3), smooth, "same")
        return np.convolve(np.gradient(speed, 1e-3), smooth, "same")[::5][: len(at)]

    heading = dense[::5, 2][: len(at)] + 0.7
    ahead = np.cos(heading) * twice(x) + np.sin(heading) * twice(y)
    left = -np.sin(heading) * twice(x) + np.cos(heading) * twice(y)
    inner = slice(20, len(ahead) - 20)
    for expected, column in ((ahead, 0), (left, 1)):
        difference = np.abs(expected[inner] - measured.force_mps2[: len(ahead), column][inner])
        assert np.quantile(difference, 0.9) < 0.03  # the rest is where the drive jerks
    assert np.abs(measured.force_mps2[:, :2]).max() > 0.5


def test_orientation_is_the_heading_from_east(world):
    at = stamps(world)
    unit = truth(world, mounting=ImuMounting(yaw_rad=0.2), datum=Datum(heading_rad=0.5))
    ahead = unit.inertial(at).enu_from_sensor[:, :, 0]
    heading = Ride(world, START_NS, 0.0).poses(at)[:, 2] + 0.7
    np.testing.assert_allclose(
        ahead, np.column_stack([np.cos(heading), np.sin(heading), 0 * heading]), atol=1e-9
    )


def test_white_noise_and_biases_are_as_large_as_the_model_says(world):
    """At rest; noise from sample to sample, biases over many units."""
    at = START_NS - 10**9 + np.arange(4000, dtype=np.int64) * 250_000  # before it drives
    measured = truth(world, MTI_G, seed=3).inertial(at)
    white = MTI_G.gyro_density_radps * math.sqrt(MTI_G.bandwidth_hz)
    assert measured.rate_radps.std(axis=0) == pytest.approx([white] * 3, rel=0.1)
    white = MTI_G.accelerometer_density_mps2 * math.sqrt(MTI_G.bandwidth_hz)
    assert measured.force_mps2.std(axis=0) == pytest.approx([white] * 3, rel=0.1)
    biases = np.array([truth(world, MTI_G, seed=k).bias_at(at[:1])[0] for k in range(300)])
    assert biases[:, :3].std() == pytest.approx(MTI_G.gyro_stability_radps, rel=0.1)
    assert biases[:, 3:].std() == pytest.approx(MTI_G.accelerometer_stability_mps2, rel=0.1)


def test_samples_do_not_depend_on_when_or_how_many_are_asked_for(world):
    at = stamps(world, 3.0)
    together, singly = truth(world, MTI_G, seed=5), truth(world, MTI_G, seed=5)
    singly.inertial(at[-1:])
    whole = together.inertial(at)
    segments = [singly.inertial(at[k : k + 7]) for k in range(0, len(at), 7)]
    np.testing.assert_array_equal(np.vstack([p.rate_radps for p in segments]), whole.rate_radps)
    np.testing.assert_array_equal(np.vstack([p.force_mps2 for p in segments]), whole.force_mps2)
    assert not np.array_equal(truth(world, MTI_G, seed=6).inertial(at).rate_radps, whole.rate_radps)
    assert together.place(int(at[5])) == singly.place(int(at[5]))


def test_places_are_the_rides_on_the_earth(world):
    datum = Datum(60.0, 25.0, 30.0, heading_rad=math.pi / 2)  # the world's x looks north, its y west
    unit = truth(world, datum=datum, gnss_sigma_m=0.0, mounting=ImuMounting(antenna_x_m=0.5))
    at = START_NS + 6_000_000_000
    x, y, theta = Ride(world, START_NS, 0.0).poses(np.array([at]))[0]
    place = unit.place(at)
    # WGS 84 at 60 deg north: a degree is 111412.27 m of latitude and 55800 m of longitude.
    north_m = (place.latitude_deg - 60.0) * 111_412.8
    east_m = (place.longitude_deg - 25.0) * 55_800.6
    assert north_m == pytest.approx(x + 0.5 * math.cos(theta), abs=2e-3)
    assert east_m == pytest.approx(-(y + 0.5 * math.sin(theta)), abs=2e-3)
    assert place.height_m == 30.0
    later = unit.place(at + 10_000_000)
    east, north, _ = place.velocity_enu_mps
    assert (later.latitude_deg - place.latitude_deg) * 111_412.8 / 0.01 == pytest.approx(north, abs=0.03)
    assert (later.longitude_deg - place.longitude_deg) * 55_800.6 / 0.01 == pytest.approx(east, abs=0.03)


def test_the_filter_places_the_unit_at_each_sample_with_the_receivers_slow_errors(world):
    """A unit whose antenna it is itself: the filter lies where the receiver lies, and moves in between."""
    at = stamps(world)
    exact, wrong = truth(world, gnss_sigma_m=0.0), truth(world, gnss_sigma_m=2.0)
    places, erring = exact.estimates(at), wrong.estimates(at)
    assert erring is not None
    assert places[40] == exact.place(int(at[40]))
    north_m = np.array([place.latitude_deg for place in places]) * 111_412.8
    north_mps = np.array([place.velocity_enu_mps[1] for place in places])
    speed_mps = np.gradient(north_m, 0.005)
    assert np.quantile(np.abs(speed_mps - north_mps), 0.9) < 0.02
    assert np.abs(north_mps).max() > 0.3
    off_m = [(e.latitude_deg - p.latitude_deg) * 111_412.8 for e, p in zip(erring, places, strict=True)]
    assert off_m[40] == pytest.approx(2.0 * wrong.receiver_error(int(at[40]))[1], rel=1e-3)
    assert np.abs(np.diff(off_m)).max() < 0.005  # it does not jump where a fix comes
    assert truth(world, gnss_sigma_m=None).estimates(at) is None


def test_receiver_errs_by_its_sigma_and_slowly(world):
    unit = truth(world, gnss_sigma_m=2.0)
    errors = np.array([unit.receiver_error(START_NS + k * 30_000_000_000) for k in range(400)])
    assert errors.std() == pytest.approx(1.0, rel=0.1)
    steps = [unit.receiver_error(START_NS + k * 250_000_000) for k in range(40)]
    assert np.abs(np.diff(steps, axis=0)).max() < 0.05
    assert truth(world, gnss_sigma_m=None).place(START_NS) is None
