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


def stamps(clock: FrameClock, measured: Ints, read_at: Ints, gap_known: bool = False) -> Ints:
    """Feed frames in order; those read at the same moment come in one read. A frame's own arrival is that
    of its read less the bytes behind it (3.2 ms a frame at 115200 baud).
    """
    got = []
    for i, read_ns in enumerate(read_at):
        behind = int(np.count_nonzero(read_at[i + 1 :] == read_ns))
        missing = 0
        if gap_known and i and measured[i] - measured[i - 1] > 1.5 * FRAME_PERIOD_NS:
            missing = round((measured[i] - measured[i - 1]) / FRAME_PERIOD_NS) - 1
        got.append(clock.stamp(int(read_ns) - behind * 3_200_000, missing))
    assert (np.diff(got) > 0).all()
    return np.array(got)


def bunched(measured: Ints, bunch_ns: int) -> Ints:
    """An adapter that hands over what it has every bunch_ns."""
    return -(-(measured + LATENCY_NS) // bunch_ns) * bunch_ns


def worst_ms(stamped: Ints, measured: Ints) -> float:
    return float(np.abs(stamped - measured).max()) * 1e-6


def test_usb_bunches_do_not_reach_the_stamps():
    measured = made_at(2000)
    read_at = bunched(measured, 80_000_000)
    assert len(set(read_at)) < 400
    got = stamps(FrameClock(LATENCY_NS), measured, read_at)
    # the clock settles on the promptest frame of the first bunches; what stays is a constant below one period
    late = got[200:] - measured[200:]
    assert np.ptp(late) < 0.3e6
    assert abs(late.mean()) < 5.5e6
    assert np.abs(np.diff(got[200:]) - FRAME_PERIOD_NS).max() < 0.3e6
    assert np.diff(read_at).max() == 80_000_000


def test_crystal_drift_is_followed():
    measured = made_at(8000, FRAME_PERIOD_NS * (1 + 120e-6))
    rng = np.random.default_rng(4)
    delay = LATENCY_NS + rng.exponential(1e6, measured.shape).astype(np.int64)
    got = stamps(FrameClock(LATENCY_NS), measured, np.maximum.accumulate(measured + delay))
    assert worst_ms(got[1000:], measured[1000:]) < 0.5


@pytest.mark.parametrize("lost", [1, 2, 5, 30])
def test_frames_lost_without_a_trace_are_noticed(lost: int):
    measured = np.delete(made_at(1500), slice(700, 700 + lost))
    clock = FrameClock(LATENCY_NS)
    got = stamps(clock, measured, measured + LATENCY_NS)
    assert clock.frames_missed == lost
    assert worst_ms(got[:700], measured[:700]) < 0.1
    noticed = 716 if lost < 6 else 704
    assert worst_ms(got[noticed:], measured[noticed:]) < 0.1


def test_damaged_frames_are_counted_at_once():
    measured = np.delete(made_at(1500), [300, 700, 701, 900])
    clock = FrameClock(LATENCY_NS)
    got = stamps(clock, measured, measured + LATENCY_NS, gap_known=True)
    assert clock.frames_missed == 4
    assert worst_ms(got, measured) < 0.1


def test_stalled_host_is_not_taken_for_lost_frames():
    measured = made_at(1500)
    read_at = measured + LATENCY_NS
    stall = (read_at > read_at[700]) & (read_at < read_at[700] + 300_000_000)
    read_at[stall] = read_at[stall][-1]
    clock = FrameClock(LATENCY_NS)
    got = stamps(clock, measured, read_at)
    assert clock.frames_missed == 0
    assert worst_ms(got, measured) < 0.1


def test_queue_read_out_frame_by_frame_is_not_taken_for_lost_frames():
    measured = made_at(1500)
    read_at = measured + LATENCY_NS
    caught_up = read_at[730] + 1_000_000 * np.arange(-30, 1)
    read_at[700:731] = np.maximum(read_at[700:731], caught_up)
    clock = FrameClock(LATENCY_NS)
    got = stamps(clock, measured, np.maximum.accumulate(read_at))
    assert clock.frames_missed == 0
    assert worst_ms(got, measured) < 0.1


def test_random_losses_under_bunching_leave_the_clock_right():
    rng = np.random.default_rng(5)
    measured = made_at(4000)
    measured = measured[np.sort(rng.permutation(4000)[:3900])]
    clock = FrameClock(LATENCY_NS)
    got = stamps(clock, measured, bunched(measured, 16_000_000), gap_known=True)
    assert clock.frames_missed == 100
    assert worst_ms(got[50:], measured[50:]) < 0.3


@pytest.mark.parametrize("rate_hz", [64.5, 68.0])
def test_robot_of_another_rate_is_measured(rate_hz: float):
    period_ns = 1e9 / rate_hz
    rng = np.random.default_rng(6)
    measured = made_at(3000, period_ns)
    delay = LATENCY_NS + rng.exponential(1e6, measured.shape).astype(np.int64)
    clock = FrameClock(LATENCY_NS)
    got = stamps(clock, measured, np.maximum.accumulate(measured + delay))
    assert clock.period_ns == pytest.approx(period_ns, rel=300e-6)
    assert clock.frames_missed == 0
    assert worst_ms(got[100:], measured[100:]) < 6.0
    assert worst_ms(got[1500:], measured[1500:]) < 1.0


def test_steady_robot_is_never_retuned():
    rng = np.random.default_rng(8)
    measured = made_at(4000)
    for delay_ms in (0.3, 3.0):
        delay = LATENCY_NS + rng.exponential(delay_ms * 1e6, measured.shape).astype(np.int64)
        clock = FrameClock(LATENCY_NS)
        stamps(clock, measured, np.maximum.accumulate(measured + delay))
        assert clock.retunes == 0


def test_restart_forgets_the_phase():
    clock = FrameClock(LATENCY_NS)
    measured = made_at(300)
    stamps(clock, measured, measured + LATENCY_NS)
    clock.restart()
    assert clock.offset_ns is None
    later = measured + 300 * FRAME_PERIOD_NS + 7_000_000
    assert worst_ms(stamps(clock, later, later + LATENCY_NS), later) < 0.1
    assert clock.frames_missed == 0
