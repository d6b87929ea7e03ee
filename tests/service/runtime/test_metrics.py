import numpy as np
import pytest

from service.runtime.metrics import LatencyHistogram


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
