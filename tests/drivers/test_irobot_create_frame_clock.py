import numpy as np
import numpy.typing as npt
import pytest

from drivers.irobot_create.frame_clock import FrameClock
from drivers.irobot_create.protocol import FRAME_PERIOD_NS

LATENCY_NS = 4_000_000
START_NS = 5_000_000_000_000
Ints = npt.NDArray[np.int64]


def made_at(count: int, period_ns: float = FRAME_PERIOD_NS) -> Ints:
    """When each frame was measured."""
    return START_NS + np.round(np.arange(count) * period_ns).astype(np.int64)


def stamps(clock: FrameClock, read_at: Ints) -> Ints:
    """Feed frames in order; those read at the same moment come in one read. A frame's own arrival is that
    of its read less the bytes behind it (3.2 ms a frame at 115200 baud).
    """
    got = []
    for i, read_ns in enumerate(read_at):
        behind = int(np.count_nonzero(read_at[i + 1 :] == read_ns))
        got.append(clock.stamp(int(read_ns) - behind * 3_200_000, 0))
    assert (np.diff(got) > 0).all()
    return np.array(got)


def worst_ms(stamped: Ints, measured: Ints) -> float:
    return float(np.abs(stamped - measured).max()) * 1e-6


@pytest.mark.parametrize("lost", [1, 2, 5, 30])
def test_frames_lost_without_a_trace_are_noticed(lost: int):
    measured = np.delete(made_at(1500), slice(700, 700 + lost))
    clock = FrameClock(LATENCY_NS)
    got = stamps(clock, measured + LATENCY_NS)
    assert clock.frames_missed == lost
    assert worst_ms(got[:700], measured[:700]) < 0.1
    noticed = 716 if lost < 6 else 704
    assert worst_ms(got[noticed:], measured[noticed:]) < 0.1


@pytest.mark.parametrize("rate_hz", [64.5, 68.0])
def test_robot_of_another_rate_is_measured(rate_hz: float):
    period_ns = 1e9 / rate_hz
    rng = np.random.default_rng(6)
    measured = made_at(3000, period_ns)
    delay = LATENCY_NS + rng.exponential(1e6, measured.shape).astype(np.int64)
    clock = FrameClock(LATENCY_NS)
    got = stamps(clock, np.maximum.accumulate(measured + delay))
    assert clock.period_ns == pytest.approx(period_ns, rel=300e-6)
    assert clock.frames_missed == 0
    assert worst_ms(got[100:], measured[100:]) < 6.0
    assert worst_ms(got[1500:], measured[1500:]) < 1.0
