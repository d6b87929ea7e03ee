import pytest

from service.fusion.gyro import GyroTrack
from tests.service.fusion.samples import MS, gyro


def track() -> GyroTrack:
    return GyroTrack(max_hold_s=0.1, bias_time_s=1.0, max_bias_radps=0.05)


def turning(rates: list[float], step_ms: float = 10.0) -> GyroTrack:
    filled = track()
    for k, rate in enumerate(rates):
        assert filled.add(gyro(k * step_ms, rate))
    return filled


def test_each_rate_is_held_until_the_next() -> None:
    filled = turning([1.0, 2.0, 4.0])
    assert filled.turn_between(5 * MS, 25 * MS) == pytest.approx(0.005 * 1.0 + 0.01 * 2.0 + 0.005 * 4.0)
    assert filled.rate_at(15 * MS) == 2.0


def test_a_gap_in_the_samples_is_not_bridged() -> None:
    filled = turning([1.0, 1.0])
    filled.add(gyro(500.0, 1.0))
    assert filled.turn_between(5 * MS, 505 * MS) is None
    assert filled.turn_between(-5 * MS, 5 * MS) is None
    assert filled.turn_between(501 * MS, 599 * MS) == pytest.approx(0.098)
    assert filled.turn_between(501 * MS, 601 * MS) is None
    assert filled.rate_at(601 * MS) is None


def test_a_late_or_broken_sample_is_refused() -> None:
    filled = turning([1.0, 1.0])
    assert not filled.add(gyro(10.0, 1.0))
    assert not filled.add(gyro(20.0, float("nan")))


def test_the_bias_is_learnt_from_matches_and_taken_off() -> None:
    filled = turning([0.02] * 1000)
    for k in range(900):
        filled.learn_bias(k * 10 * MS, (k + 1) * 10 * MS, 0.0)
    assert filled.bias_radps == pytest.approx(0.02, rel=1e-3)
    assert filled.turn_between(0, 1000 * MS) == pytest.approx(0.0, abs=1e-4)


def test_a_bias_beyond_belief_is_not_followed() -> None:
    filled = turning([3.0] * 1000)
    for k in range(900):
        filled.learn_bias(k * 10 * MS, (k + 1) * 10 * MS, 0.0)
    assert filled.bias_radps == 0.05


def test_a_day_of_samples_does_not_pile_up() -> None:
    filled = turning([0.0] * 40_000)
    assert len(filled._stamps) < 9000
