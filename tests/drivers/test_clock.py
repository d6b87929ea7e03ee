"""The clock map against clocks whose truth is known."""

import numpy as np
import pytest

from drivers.clock import ClockMap

PERIOD_S = 0.02006
LATENCY_S = 0.8e-3
WRAP = 2**32


class Stream:
    """Messages of a device whose clock runs `drift_ppm` fast, wanders, and whose messages come late."""

    def __init__(self, seed, count=3000, drift_ppm=100.0, wander_ppm=0.0):
        self.rng = np.random.default_rng(seed)
        self.sent_s = 50.0 + np.arange(count) * PERIOD_S
        turn = 2 * np.pi * self.sent_s / 240.0
        device_s = self.sent_s * (1 + drift_ppm * 1e-6) - wander_ppm * 1e-6 * 240.0 / (2 * np.pi) * np.cos(
            turn
        )
        self.ticks = np.rint((device_s - device_s[0]) * 1e6).astype(np.int64) + WRAP - 5_000_000
        jitter_s = self.rng.uniform(0.0, 3e-3, count)
        late = self.rng.random(count) < 0.05
        jitter_s[late] += self.rng.uniform(0.0, 50e-3, int(late.sum()))
        self.arrived_s = np.maximum.accumulate(self.sent_s + LATENCY_S + jitter_s)

    def through(self, clock):
        """Error of each translated stamp, ms, and the stamps, ns."""
        stamps_ns = []
        for ticks, arrived_s in zip(self.ticks, self.arrived_s, strict=True):
            clock.observe(int(ticks % WRAP), round(arrived_s * 1e9))
            stamps_ns.append(clock.to_host_ns(int(ticks % WRAP)))
        stamps_ns = np.array(stamps_ns)
        return (stamps_ns - self.sent_s * 1e9) / 1e6, stamps_ns


def microseconds():
    return ClockMap(1_000.0, WRAP)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("drift_ppm", "wander_ppm"), [(100, 0), (-100, 0), (250, 0), (30, 10)])
def test_stamps_keep_a_constant_bias_through_jitter_bursts_drift_and_a_wrap(seed, drift_ppm, wander_ppm):
    stream = Stream(seed, drift_ppm=drift_ppm, wander_ppm=wander_ppm)
    clock = microseconds()
    error_ms, stamps_ns = stream.through(clock)
    old = np.arange(len(error_ms)) * PERIOD_S > 10.0
    assert error_ms[old].std() <= 0.2
    assert abs(error_ms[old].mean() - LATENCY_S * 1e3) <= 0.2
    assert np.abs(error_ms).max() < 60.0
    assert np.diff(stamps_ns[old]).min() > 0
    assert clock.resets == clock.runaways == 0
    if not wander_ppm:
        assert clock.skew_ppm == pytest.approx(-drift_ppm, abs=5.0)


@pytest.mark.parametrize("drift_ppm", [100.0, -100.0])
def test_twenty_wraps_of_24_hours_are_passed(drift_ppm):
    rng = np.random.default_rng(3)
    clock = microseconds()
    day_s = 24 * 3600
    sent_s = np.arange(0.0, day_s, 5.0)
    ticks = np.rint(sent_s * 1e6 * (1 + drift_ppm * 1e-6)).astype(np.int64) + WRAP - 1_000
    assert ticks[-1] // WRAP == 21  # it begins shortly before one
    error_ms = []
    for at_s, tick in zip(sent_s, ticks, strict=True):
        clock.observe(int(tick % WRAP), round((at_s + LATENCY_S + rng.uniform(0.0, 3e-3)) * 1e9))
        error_ms.append(clock.to_host_ns(int(tick % WRAP)) / 1e6 - at_s * 1e3)
    assert clock.resets == clock.runaways == 0
    assert np.abs(error_ms).max() < 10.0  # few messages tell of few prompt ones; a wrap missed were 4295 s


@pytest.mark.parametrize(
    ("jump_us", "pause_s"),
    [
        *((jump_us, 0.0) for jump_us in (-60_000, -200_000, -499_000)),  # known from the second message on
        *((jump_us, 0.0) for jump_us in (-30_000_000, -2_000_000_000, 5_000_000, 1_500_000_000)),
        (4_400_000, 5.0),  # it stood still for 0.6 s of 5 s without messages, and only looks late
    ],
)
def test_clock_that_is_set_or_begins_again_is_learnt_within_three_seconds(jump_us, pause_s):
    stream = Stream(1)
    stream.ticks[1500:] += jump_us
    stream.sent_s[1500:] += pause_s
    stream.arrived_s[1500:] += pause_s
    clock = microseconds()
    error_ms, _ = stream.through(clock)
    learnt = 1500 + round(3.0 / PERIOD_S)
    assert clock.resets == 1
    assert np.abs(error_ms[learnt:] - LATENCY_S * 1e3).max() < 1.0
    if -500_000 < jump_us < 0:
        assert np.abs(error_ms[1501:learnt]).max() < 60.0


@pytest.mark.parametrize("back", [0, 1, 5, 20])
def test_messages_out_of_order_or_twice_change_nothing(back):
    undisturbed_ms, _ = Stream(1).through(microseconds())
    stream, clock = Stream(1), microseconds()
    for name in ("ticks", "sent_s", "arrived_s"):
        values = getattr(stream, name)
        for at in (2500, 2000, 1500, 1000):
            again = values[at] if name == "arrived_s" else values[at - back]
            values = np.insert(values, at + 1, again)
        setattr(stream, name, values)
    error_ms, _ = stream.through(clock)
    assert clock.resets == 0
    np.testing.assert_allclose(np.delete(error_ms, [1001, 1502, 2003, 2504]), undisturbed_ms, atol=0.01)


def test_messages_delayed_by_the_network_are_late_and_no_restart():
    stream = Stream(2)
    delayed = (stream.sent_s > 80.0) & (stream.sent_s < 83.0)
    stream.arrived_s[delayed] = np.maximum(stream.arrived_s[delayed], 83.0)
    stream.arrived_s = np.maximum.accumulate(stream.arrived_s)
    clock = microseconds()
    error_ms, _ = stream.through(clock)
    assert clock.resets == 0
    assert error_ms[stream.sent_s > 62.0].std() <= 0.2


@pytest.mark.parametrize("gained_per_s", [0.04, 0.2])
@pytest.mark.parametrize("lateness_s", [0.3, 1.0])
def test_a_sender_that_falls_behind_and_stays_behind_keeps_its_stamps(gained_per_s, lateness_s):
    """A queue that fills, of a process without a processor or of a slow link, is not the device's clock."""
    stream = Stream(5, count=6000)
    behind_s = np.clip((stream.sent_s - 80.0) * gained_per_s, 0.0, lateness_s)
    behind_s[stream.sent_s > 140.0] = 0.0  # longer than a hull is used
    stream.arrived_s = np.maximum.accumulate(stream.arrived_s + behind_s)
    clock = microseconds()
    error_ms, _ = stream.through(clock)
    assert clock.resets == clock.runaways == 0
    assert np.abs(error_ms[stream.sent_s > 62.0]).max() < 25.0


def test_clock_that_runs_away_is_followed_and_counted():
    stream = Stream(4, drift_ppm=-2_000.0)  # 2 ms a second slow: no crystal
    clock = microseconds()
    error_ms, _ = stream.through(clock)
    assert clock.runaways > 0
    assert np.abs(error_ms).max() < 60.0


def test_latency_is_taken_off():
    clock = ClockMap(1_000.0, None, latency_ns=700)
    clock.observe(5, 10_000)
    assert clock.to_host_ns(5) == 9_300
    assert clock.to_host_ns(4) == 8_300
    assert clock.offset_ns == 5_000


def test_asking_before_the_first_message_is_refused():
    assert microseconds().offset_ns is None
    with pytest.raises(ValueError, match="observe"):
        microseconds().to_host_ns(1)


def test_how_well_an_offset_is_known_is_reported_in_its_own_standard_deviation():
    """Of exponential lateness the least of n scatters by the mean over n."""
    rng = np.random.default_rng(5)
    errors_ns, sigmas_ns = [], []
    for _ in range(400):
        clock = ClockMap(1_000.0)
        for k in range(8):
            clock.observe(k * 20_000, round(k * 20e6 + rng.exponential(10e6)))
        errors_ns.append(clock.offset_ns)
        sigmas_ns.append(clock.offset_sigma_ns)
    assert np.std(errors_ns) == pytest.approx(np.mean(sigmas_ns), rel=0.25)
