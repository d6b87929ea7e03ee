"""How true the stamps are: a fake device's clock drifts, its messages jitter and bunch, and it restarts."""

import numpy as np
import pytest

from drivers.frames import ImuSample
from drivers.xsens_mtig.sample_clock import CounterClock, FineClock
from simulators.xsens_mtig import FakeMtiG, MtigSetup
from tests.drivers.mtig import MS, ZERO_NS, Swing, legacy, mtdata2, samples, talk
from tests.drivers.virtual_time import SECOND_NS

LATENCY_MS = 1.0  # of the fake device


def errors_ms(taken: list[ImuSample]) -> np.ndarray:
    """Stamp less true moment, which the rate about z tells to 0.1 us."""
    return np.array([(s.stamp_ns - ZERO_NS) * 1e-6 - s.rate_radps[2] * 1e3 for s in taken])


def test_an_adapter_that_hands_over_every_16_ms_costs_two_milliseconds_not_sixteen():
    """Samples each 5 ms meet its timer in 16 phases, so none comes nearer than within 1 ms of at once."""
    device = FakeMtiG(Swing(), MtigSetup(clock_drift_ppm=40.0))
    t = talk(device)
    t.delay_ns = lambda: 16 * MS - (t.now_ns - ZERO_NS) % (16 * MS)
    t.run(20.0)
    late = errors_ms([s for s in samples(t.frames) if s.stamp_ns > ZERO_NS + 10 * SECOND_NS])
    assert late.min() > LATENCY_MS - 1.0
    assert late.max() < LATENCY_MS + 2.0


def wrapping(modulus, step, count, start):
    return [(start + i * step) % modulus for i in range(count)]


@pytest.mark.parametrize("modulus", [864_000_000, 1 << 32])
def test_days_of_sample_time_pass_in_order(modulus):
    """Three wraps in steps of 40 s, either modulus: what is one is only known at the wrap."""
    clock = FineClock(0)
    count = 3 * modulus // 400_000
    stamps = []
    for i, ticks in enumerate(wrapping(modulus, 400_000, count, 12_345)):
        clock.observe(ticks, i * 40 * SECOND_NS)
        stamps.append(clock.to_host_ns(ticks))
    assert np.abs(np.diff(stamps) - 40 * SECOND_NS).max() < MS
    assert clock.resets == 0


def test_sample_time_may_step_back_a_little_over_the_wrap():
    clock = FineClock(0)
    clock.observe(863_999_990, 0)
    clock.observe(40, 5 * MS)
    assert clock.to_host_ns(863_999_600) == pytest.approx(5 * MS - 44 * MS, abs=MS)
    assert clock.step(863_999_600) == -440
    clock.observe(90, 10 * MS)
    assert clock.step(140) == 50
    assert clock.resets == 0


def test_sample_time_that_begins_again_near_its_wrap_is_no_wrap():
    clock = FineClock(0)
    for i in range(600):
        clock.observe(863_900_000 + 50 * i, i * 5 * MS)
    for i in range(600):
        clock.observe(50 * i, (700 + i) * 5 * MS)
    assert clock.resets == 1
    assert clock.to_host_ns(50 * 599) == pytest.approx(1299 * 5 * MS, abs=MS)


def test_a_counter_that_counts_skipped_samples_is_found_out_and_one_lost_first_is_forgiven():
    clock = CounterClock(20 * MS, 1, 0)
    missing = [clock.observe(2 * i, i * 20 * MS) for i in range(100)]
    assert sum(missing) == 0
    assert clock.to_host_ns(198) == pytest.approx(99 * 20 * MS, abs=MS)
    clock = CounterClock(20 * MS, 1, 0)
    counts = [0, *range(2, 200)]  # 1 was lost, so the first step looks like a skip
    missing = [clock.observe(count, count * 20 * MS) for count in counts]
    assert clock.to_host_ns(199) == pytest.approx(199 * 20 * MS, abs=MS)
    assert sum(missing) == 0  # the one before we knew


@pytest.mark.parametrize("make", [mtdata2, legacy])
def test_samples_within_a_burst_of_noise_are_not_old(make):
    """Half a second of samples among garbage in one read: 160 kB, which would be 14 s of the line."""
    t = talk(make()).run(5.0)
    noisy, rng = bytearray(), np.random.default_rng(1)
    for _ in range(200):
        t.now_ns = max(t.now_ns, t.device.next_due_ns(t.now_ns))
        noisy += rng.integers(0, 0xF0, 800, dtype=np.uint8).tobytes() + t.device.due(t.now_ns)
    before = len(t.frames)
    t.frames += t.session.receive_data(bytes(noisy), t.now_ns)
    t.run(5.0)
    taken = samples(t.frames)
    assert len(samples(t.frames[before:])) > 1_080
    assert np.abs(errors_ms(taken[10:]) - 1.0).max() < 5.0
    assert min(np.diff([sample.stamp_ns for sample in taken])) > 0
    assert t.session.counters["clock_resets"] == 0
