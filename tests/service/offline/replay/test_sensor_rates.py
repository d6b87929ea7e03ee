from dataclasses import replace

from service.offline.replay.sensor_rates import SensorRates
from tests.service.offline.recorded_drives import T0_NS, odometry_at, room_scan

PERIOD_NS = 20_000_000


def rates_of(*scans: int) -> dict:
    """Of a laser that scanned at these multiples of 20 ms."""
    rates = SensorRates()
    for k in scans:
        rates.add(room_scan(T0_NS + k * PERIOD_NS, 0.0))
    return rates.as_dict(T0_NS)["front/scan"]


def test_an_interval_of_more_than_three_periods_is_a_gap():
    assert rates_of(*range(10), *range(12, 20), *range(60, 70)) == {
        "frames": 28,
        "rate_hz": 50.0,
        "gaps": 1,
        "longest_gaps": [[0.38, 0.82]],
    }


def test_kinds_of_one_sensor_are_distinguished_and_a_single_frame_has_no_rate():
    rates = SensorRates()
    rates.add(replace(odometry_at(0, 0.0), sensor="front"))
    rates.add(room_scan(T0_NS, 0.0))
    assert list(rates.as_dict(T0_NS)) == ["front/odom", "front/scan"]
    assert rates.as_dict(T0_NS)["front/odom"]["rate_hz"] is None
