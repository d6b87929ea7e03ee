import numpy as np
import pytest

from service.runtime.metrics import LatencyHistogram, Percentiles, RateMeter


def test_percentiles_agree_with_numpy_to_a_bucket():
    durations_ns = np.random.default_rng(1).lognormal(14.5, 0.7, 5_000).astype(int)
    histogram = LatencyHistogram()
    for duration_ns in durations_ns:
        histogram.add(int(duration_ns))
    found = histogram.percentiles()
    for share, value_ms in ((50, found.p50), (95, found.p95), (99, found.p99)):
        expected_ms = np.percentile(durations_ns, share, method="inverted_cdf") / 1e6
        assert value_ms == pytest.approx(expected_ms, rel=0.012)
    assert found.max == pytest.approx(durations_ns.max() / 1e6, abs=5e-4)


def test_no_percentile_exceeds_the_longest():
    histogram = LatencyHistogram()
    histogram.add(2_010_000)
    found = histogram.percentiles()
    assert found.p50 == found.p95 == found.p99 == pytest.approx(2.01, rel=0.012)
    assert found.p99 <= found.max == 2.01


def test_nothing_measured_is_nought():
    assert LatencyHistogram().percentiles() == Percentiles(0.0, 0.0, 0.0, 0.0)


def test_durations_off_the_scale_are_kept_in_its_last_bucket():
    histogram = LatencyHistogram()
    histogram.add(-5)
    histogram.add(10**15)
    assert histogram.count == 2
    assert histogram.percentiles().max == 1e9


def test_a_rate_is_that_since_the_last_reading():
    meter = RateMeter()
    assert meter.read(100, 0) == 0.0
    assert meter.read(150, 1_000_000_000) == 50.0
    assert meter.read(150, 1_000_000_000) == 50.0  # no time passed, nothing learnt
    assert meter.read(160, 1_100_000_000) == 50.0  # 10 in 0.1 s: too short to tell
    assert meter.read(160, 3_000_000_000) == 5.0
