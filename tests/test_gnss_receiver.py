import math

import numpy as np
import pytest

from service.geometry.geo_reference import LocalFrame
from tests.gnss_receiver import GnssModel, Receiver, Reflection

ORIGIN = LocalFrame(60.161, 24.546, 51.7)


def errors_m(model: GnssModel, seed: int, times_s: np.ndarray) -> np.ndarray:
    """(N, 2) east and north of a receiver that stands at the origin."""
    receiver = Receiver(model, seed, ORIGIN)
    fixes = [receiver.fix("imu", round(t * 1e9), (0.0, 0.0)) for t in times_s.tolist()]
    return np.array([ORIGIN.to_enu(f.latitude_deg, f.longitude_deg, 51.7)[:2] for f in fixes])


def test_the_error_is_as_large_as_configured_and_lasts_as_long():
    model = GnssModel(lasting_sigma_m=1.5, correlation_s=45.0)
    off = np.array([errors_m(model, seed, np.array([0.0, 500.0, 545.0])) for seed in range(400)])
    assert off.std() == pytest.approx(1.5, rel=0.08)
    after_45_s = (off[:, 1] * off[:, 2]).mean() / off.var()
    assert after_45_s == pytest.approx(math.exp(-1.0), abs=0.1)


def test_a_reflection_comes_and_goes_at_once_and_is_not_reported():
    model = GnssModel(reflections=[Reflection(10.0, 20.0, 3.0, -4.0)])
    times_s = np.arange(0.0, 30.0, 0.25)
    off = errors_m(model, 1, times_s) - errors_m(GnssModel(), 1, times_s)
    within = (times_s >= 10.0) & (times_s < 20.0)
    np.testing.assert_allclose(off[within], np.tile((3.0, -4.0), (within.sum(), 1)), atol=0.02)
    np.testing.assert_allclose(off[~within], 0.0, atol=0.02)


def test_in_an_outage_there_is_no_position():
    receiver = Receiver(GnssModel(outages=[(5.0, 6.0)]), 1)
    lost = receiver.fix("imu", 5_500_000_000, (0.0, 0.0))
    assert lost.status == -1
    assert math.isnan(lost.latitude_deg)
    assert receiver.fix("imu", 6_000_000_000, (0.0, 0.0)).status == 0


def test_a_turned_world_is_turned():
    model = GnssModel(lasting_sigma_m=0.0, noise_sigma_m=0.0)
    fix = Receiver(model, 1, ORIGIN, world_yaw_rad=math.radians(90.0)).fix("imu", 0, (100.0, 0.0))
    east_m, north_m, _ = ORIGIN.to_enu(fix.latitude_deg, fix.longitude_deg, fix.altitude_m)
    np.testing.assert_allclose((east_m, north_m), (0.0, 100.0), atol=0.02)
