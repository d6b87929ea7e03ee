"""The scan clock alone: what TM1 bounds, the line below the upper bounds, 24 hours of wraps."""

import numpy as np
import pytest

from drivers.hokuyo_utm30lx.scan_clock import ScanClock, TimeSample, bounds_of_time

MS = 1_000_000
WRAP = 1 << 24
DELAY_MS = 19.4


@pytest.mark.parametrize("seed", range(5))
def test_bounds_from_tm1_hold_the_truth_and_get_narrow(seed):
    rng = np.random.default_rng(seed)
    offset_ms = 123_456.7 + rng.random()  # host minus device clock
    samples, host_ms = [], offset_ms + WRAP - 5.0  # the wrap comes in between
    for _ in range(40):
        there_ms, back_ms = rng.uniform(0.05, 0.3, 2)
        shown_ms = int(host_ms + there_ms - offset_ms) % WRAP
        samples.append(TimeSample(round(host_ms * MS), shown_ms, round((host_ms + there_ms + back_ms) * MS)))
        host_ms += there_ms + back_ms + rng.uniform(0.0, 0.4)
    lowest, highest = bounds_of_time(samples)
    truth = (offset_ms + (samples[0].device_ms if samples[0].device_ms > 10 else WRAP)) * MS
    assert lowest <= truth <= highest
    assert highest - lowest < 0.6 * MS


def test_contradicting_samples_bound_nothing():
    assert bounds_of_time([]) is None
    assert not ScanClock(25e6, 0).synchronise([TimeSample(0, 0, MS), TimeSample(5 * MS, 50, 6 * MS)])


@pytest.mark.parametrize("every", [400, 20, 5])
def test_scans_that_are_delayed_and_stamped_in_a_bunch_do_not_shorten_the_period(every):
    """As a unit does that stamps what it sends: eight sweeps of each bunch lie one millisecond apart."""
    clock = ScanClock(25e6, round(DELAY_MS * MS))
    delayed_until_ms = last_ms = 0
    for sweep in range(2000):
        due_ms = 1000 + sweep * 25
        if sweep % every == every - 1:
            delayed_until_ms = due_ms + 200
        last_ms = max(due_ms, delayed_until_ms, last_ms + 1)
        stamp_ns = clock.stamp(last_ms, round((last_ms + DELAY_MS) * MS))
        assert stamp_ns == pytest.approx(last_ms * MS, abs=MS)
    assert clock.period_ns == pytest.approx(25e6, rel=1e-6)
    assert clock.too_close > 2000 // every
