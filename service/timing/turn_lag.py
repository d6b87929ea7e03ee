"""By how much the stamps of a source of motion are off against those of the scans, by the turns both saw.

theta(t) is the heading at which a scan lies on the map. Where a source's stamps are `lag_s` ahead, its turn
from t + lag_s to t' + lag_s is that from theta(t) to theta(t'): the lag is where the turns of many pairs of
scans correlate best. A wrong scale of the turns or a bias of a gyro does not change that.
"""

import math
from collections import deque
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

MAX_LAG_S, STEP_S = 1.2, 0.03  # lags that are tried
LONGEST_GAP_S = 0.6  # between two scans
SCANS, SAMPLES = 400, 8192  # the newest count
FIRST_JUDGED, MAX_BETWEEN = 40, 1600  # scans; judged at twice as many each time, at last each so many
MIN_PAIRS = 25
MIN_RATE_RADPS = 0.05  # standard deviation of the rate of turn: below, nothing tells the lag
MIN_CORRELATION = 0.9  # of both rates of turn, for a lag to be known
MAX_UNEXPLAINED = 0.35  # of the variance that a lag of 0 leaves unexplained: an offset explains the rest
SAME_LAG_S = 0.05  # by each half of the turns
SAME_ERRORS = 4.0  # scans whose headings have the same error


class Lag(NamedTuple):
    """Stamps of the source are so much ahead of those of the scans, and how well that is known."""

    lag_s: float
    sigma_s: float
    scans: int  # by how many


class TurnLag:
    """Of one source of motion. Headings and turns come by rising stamps."""

    def __init__(self) -> None:
        self._scans: deque[tuple[int, float]] = deque(maxlen=SCANS)  # stamp, heading; NaN: unknown
        self._samples: deque[tuple[int, float]] = deque(maxlen=SAMPLES)  # stamp, turn since any beginning
        self._count = 0
        self._judged_at = FIRST_JUDGED

    def add_sample(self, stamp_ns: int, turn_rad: float) -> None:
        """turn_rad   a heading, or an integral of rates; wrapped or not"""
        self._samples.append((stamp_ns, turn_rad))

    def forget_samples(self) -> None:
        """Their stamps are from here on of another clock."""
        self._samples.clear()
        self._count, self._judged_at = 0, FIRST_JUDGED

    def add_scan(self, stamp_ns: int, heading_rad: float) -> Lag | None:
        """heading_rad   NaN where the scan lay nowhere. An offset, if this scan shows one."""
        self._scans.append((stamp_ns, heading_rad))
        self._count += 1
        if self._count < self._judged_at:
            return None
        self._judged_at += min(self._judged_at, MAX_BETWEEN)
        return self._judged()

    def _judged(self) -> Lag | None:
        if len(self._samples) < 2:
            return None
        scans, samples = np.array(self._scans), np.array(self._samples)
        began_ns = scans[0, 0]
        times, heading = (scans[:, 0] - began_ns) * 1e-9, scans[:, 1]
        sampled, turn = (samples[:, 0] - began_ns) * 1e-9, np.unwrap(samples[:, 1])
        is_known = (times > sampled[0] + MAX_LAG_S) & (times < sampled[-1] - MAX_LAG_S)
        gap = np.diff(times)
        pairs = (
            is_known[1:]
            & is_known[:-1]
            & (gap > 0.0)
            & (gap <= LONGEST_GAP_S)
            & np.isfinite(np.diff(heading))
        )
        if pairs.sum() < MIN_PAIRS:
            return None
        turned = (np.diff(heading)[pairs] + math.pi) % math.tau - math.pi
        if np.std(turned / gap[pairs]) < MIN_RATE_RADPS:
            return None
        lags = np.arange(-MAX_LAG_S, MAX_LAG_S + 0.5 * STEP_S, STEP_S)
        facts = np.diff(np.interp(times[None, :] + lags[:, None], sampled, turn), axis=1)[:, pairs]
        half = int(np.searchsorted(np.cumsum(np.abs(turned)), 0.5 * np.abs(turned).sum()))
        halves = [best_lag(turned[part], facts[:, part], lags) for part in (slice(half), slice(half, None))]
        lag = best_lag(turned, facts, lags)
        if lag is None or any(one is None or abs(one.lag_s - lag.lag_s) > SAME_LAG_S for one in halves):
            return None  # a wheel that slips in one turn looks like a lag there
        return lag


def best_lag(
    turned: npt.NDArray[np.float64], facts: npt.NDArray[np.float64], lags_s: npt.NDArray[np.float64]
) -> Lag | None:
    """None where no lag explains the turns much better than 0.

    turned   (K,) rad    between two scans
    facts    (L, K) rad  the same by the source, at each of L lags, evenly apart, with 0 in the middle
    """
    if len(turned) == 0 or np.ptp(turned) == 0.0:
        return None  # one jump of the heading may be half of all that was turned
    x = turned - turned.mean()
    y = facts - facts.mean(axis=1, keepdims=True)
    power = np.maximum((y * y).sum(axis=1), 1e-12)
    correlation = (y @ x) / np.sqrt(power * (x @ x))
    best = int(correlation.argmax())
    none = len(lags_s) // 2
    if best in (0, none, len(lags_s) - 1) or correlation[best] < MIN_CORRELATION:
        return None
    left, top, right = correlation[best - 1 : best + 2]
    if (curvature := left - 2.0 * top + right) == 0.0:
        return None
    shift = 0.5 * (left - right) / curvature
    lag_s = float(lags_s[best] + shift * (lags_s[1] - lags_s[0]))
    left_over = max(1.0 - correlation[best] ** 2, 0.0)
    if left_over > MAX_UNEXPLAINED * (1.0 - max(correlation[none], 0.0) ** 2):
        return None
    scale = (y[best] @ x) / power[best]
    slope = scale * (y[best + 1] - y[best - 1]) / (lags_s[2] - lags_s[0])
    noise = left_over * (x @ x) / max(len(x) - 3, 1)
    return Lag(lag_s, math.sqrt(SAME_ERRORS * noise / max(slope @ slope, 1e-12)), len(x))
