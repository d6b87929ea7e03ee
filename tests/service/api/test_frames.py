import math

import numpy as np
import pytest

import corridor


def test_a_scan_is_what_the_wire_makes_of_it():
    range_m = np.array([1.0, np.inf, np.nan, 0.0, 0.05, 100.0, 2.5])
    made = corridor.scan(range_m, -1.5, 0.5, 10**9, range_min_m=0.1, intensity=np.arange(7))
    assert (made.sensor, made.stamp_ns, made.arrived_ns) == ("laser", 10**9, 10**9)
    np.testing.assert_array_equal(made.range_m, np.float32([1.0, *[np.nan] * 5, 2.5]))
    np.testing.assert_array_equal(made.intensity, np.arange(7, dtype=np.float32))
    assert made.first_angle_rad == pytest.approx(-1.5)
    assert made.angle_step_rad == pytest.approx(0.5)


def test_what_a_mask_covers_is_no_return():
    made = corridor.scan(np.ma.masked_less(np.array([1.0, 2.0, 3.0]), 2.0), 0.0, 0.1, 0)
    np.testing.assert_array_equal(made.range_m, np.float32([np.nan, 2.0, 3.0]))


def test_the_array_of_the_program_stays_writable():
    range_m = np.ones(5, np.float32)
    made = corridor.scan(range_m, 0.0, 0.1, 0)
    range_m[0] = 7.0
    assert made.range_m[0] == 1.0
    assert not made.range_m.flags.writeable


def test_samples_and_fixes_keep_their_values():
    sample = corridor.odometry(1.0, 2.0, 0.5, 5, twist=(0.1, 0.0, 0.2), covariance=np.diag([4.0, 5.0, 6.0]))
    assert (sample.sensor, sample.x_m, sample.y_m) == ("base", 1.0, 2.0)
    assert sample.theta_rad == pytest.approx(0.5, abs=1e-11)
    assert sample.twist_mps_radps == (0.1, 0.0, 0.2)
    assert sample.covariance == (4.0, 0.0, 0.0, 0.0, 5.0, 0.0, 0.0, 0.0, 6.0)
    inertial = corridor.imu(np.array([0.0, 0.1, 0.2]), [0.0, 0.0, 9.81], 6)
    assert (inertial.rate_radps, inertial.force_mps2) == ((0.0, 0.1, 0.2), (0.0, 0.0, 9.81))
    found = corridor.fix(50.1, 14.4, 7, covariance=np.eye(3), status=2)
    assert (found.latitude_deg, found.longitude_deg, found.status) == (50.1, 14.4, 2)
    assert math.isnan(found.altitude_m)
    assert found.covariance == tuple(np.eye(3).ravel())


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: corridor.scan([[1.0]], 0.0, 0.1, 0), r"range_m of shape \(1, 1\); expected one row"),
        (lambda: corridor.scan(["1.0 m"], 0.0, 0.1, 0), "laser: range_m are no numbers"),
        (lambda: corridor.scan([1.0, 2.0], 0.0, 0.0, 0), "angle_step_rad that is not 0"),
        (lambda: corridor.scan([], 0.0, 0.1, 0), "no measurement"),
        (lambda: corridor.scan([1.0], math.nan, 0.1, 0), "finite first_angle_rad"),
        (lambda: corridor.scan([1.0], 0.0, 0.1, 0, range_min_m=5.0, range_max_m=4.0), "range_min_m < range"),
        (lambda: corridor.scan([1.0], 0.0, 0.1, -1), "stamp_ns is -1; expected whole ns from 0 to"),
        (lambda: corridor.scan([1.0], 0.0, 0.1, 1.7e9), r"stamp_ns is 1700000000\.0; expected whole ns"),
        (lambda: corridor.scan([1.0, 1.0], 0.0, 0.1, 0, intensity=[1]), "1 values of intensity for 2 beams"),
        (lambda: corridor.odometry(math.inf, 0.0, 0.0, 0), "base at 0 ns: no measurement; expected finite"),
        (lambda: corridor.odometry(0.0, 0.0, 0.0, 0, twist=(1.0,)), "twist has 1 values; expected 3"),
        (lambda: corridor.imu((0.0, 0.0, 1e4), (0.0, 0.0, 9.8), 0), "rates up to 1e3 rad/s"),
        (lambda: corridor.imu((0.0, 0.0), (0.0, 0.0, 9.8), 0), "rate_radps has 2 values; expected 3"),
        (lambda: corridor.fix(91.0, 0.0, 0), "latitude 91.0"),
        (lambda: corridor.fix(0.0, 0.0, 0, covariance=[math.nan] * 9), "finite covariance"),
    ],
)
def test_what_is_no_measurement_is_refused_in_words(make, words):
    with pytest.raises(corridor.InputError, match=words):
        make()
