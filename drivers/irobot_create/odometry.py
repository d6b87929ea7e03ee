"""Wheel travel -> pose, covariance and twist of the base. No bytes, no clock.

Axes: x forward, y left, theta counter-clockwise, in a frame that starts where the first sample was taken.
"""

import math
from collections import deque

import numpy as np
import numpy.typing as npt

from drivers.frames import OdometrySample

COUNTER_MODULUS = 1 << 16
TWIST_SAMPLES = 7  # six intervals of 15 ms: one count is then 5 mm/s, not 30
FASTEST_MPS = 0.5  # of a wheel, by the manual's range of opcode 145


def counts_between(old: int, new: int) -> int:
    """Travel from one 16-bit counter reading to the next, -32768..32767 counts, across the wrap."""
    half = COUNTER_MODULUS // 2
    return (new - old + half) % COUNTER_MODULUS - half


def inside_truncated(whole: int, predicted: float) -> float:
    """The value nearest to `predicted` that a device cuts to `whole` when it drops the fraction.

    Whole n > 0 stands for [n, n + 1), n < 0 for (n - 1, n], 0 for (-1, 1). Without a prediction every reading
    loses half a unit on average, and a slow turn read often is lost completely.
    """
    low = whole if whole > 0 else whole - 1
    high = whole if whole < 0 else whole + 1
    return min(max(predicted, float(low)), float(high))


class DeadReckoning:
    """Pose of a differential drive, integrated along exact arcs, with the covariance of its errors.

    It may outlive a connection: handed to the next session, the pose continues from its last value.

    wheel_base_m              distance of the wheels' contact points, m
    travel_variance_m2_per_m  variance of a wheel's travel per metre rolled, m

    Source: Siegwart, Nourbakhsh, Introduction to Autonomous Mobile Robots, 1st ed., section 5.2.4. With wheel
    travels sR, sL, ds = (sR + sL) / 2, dth = (sR - sL) / B and a = theta + dth / 2 the covariance follows

        P' = Fp P Fp^T + Fu Q Fu^T,   Q = diag(k |sR|, k |sL|)                                  (5.8, 5.9)

             | 1  0  -ds sin a |        | cos(a)/2 - ds sin(a)/(2B)   cos(a)/2 + ds sin(a)/(2B) |
        Fp = | 0  1   ds cos a |   Fu = | sin(a)/2 + ds cos(a)/(2B)   sin(a)/2 - ds cos(a)/(2B) | (5.10, 5.11)
             | 0  0      1     |        |            1/B                        -1/B            |

    The pose itself follows the arc: a chord of length ds sin(dth/2) / (dth/2) in direction a.
    """

    def __init__(self, wheel_base_m: float, travel_variance_m2_per_m: float) -> None:
        self._wheel_base_m = wheel_base_m
        self._travel_variance = travel_variance_m2_per_m
        self.x_m = 0.0
        self.y_m = 0.0
        self.theta_rad = 0.0  # -pi..pi
        self.stamp_ns: int | None = None  # of the pose; None before the first reading
        self._covariance: npt.NDArray[np.float64] = np.zeros((3, 3))

    @property
    def covariance(self) -> tuple[float, ...]:
        """9 values, row-major (x, y, theta) in the frame's axes; m^2, m rad, rad^2."""
        return tuple(self._covariance.ravel().tolist())

    def sample(
        self, sensor: str, stamp_ns: int, arrived_ns: int, twist_mps_radps: tuple[float, float, float]
    ) -> OdometrySample:
        """The pose, which is that of stamp_ns, as a frame."""
        self.stamp_ns = stamp_ns
        return OdometrySample(
            sensor=sensor,
            stamp_ns=stamp_ns,
            arrived_ns=arrived_ns,
            x_m=self.x_m,
            y_m=self.y_m,
            theta_rad=self.theta_rad,
            twist_mps_radps=twist_mps_radps,
            covariance=self.covariance,
        )

    def roll(self, left_m: float, right_m: float, reading_variance_rad2: float = 0.0) -> tuple[float, float]:
        """Add the travel of both wheels since the last call, m; returns (ds in m, dth in rad).

        `reading_variance_rad2` is that of dth beyond the wheels' own, for a device that rounds it.
        """
        base_m = self._wheel_base_m
        ds, dth = 0.5 * (left_m + right_m), (right_m - left_m) / base_m
        a = self.theta_rad + 0.5 * dth
        cos_a, sin_a = math.cos(a), math.sin(a)
        chord_m = ds * _sinc(0.5 * dth)
        self.x_m += chord_m * cos_a
        self.y_m += chord_m * sin_a
        self.theta_rad = math.remainder(self.theta_rad + dth, math.tau)
        if left_m == 0.0 and right_m == 0.0 and reading_variance_rad2 == 0.0:
            return ds, dth
        to_pose = np.array([[1.0, 0.0, -ds * sin_a], [0.0, 1.0, ds * cos_a], [0.0, 0.0, 1.0]])
        lever = ds / (2.0 * base_m)
        to_travel = np.array(
            [
                [0.5 * cos_a - lever * sin_a, 0.5 * cos_a + lever * sin_a],
                [0.5 * sin_a + lever * cos_a, 0.5 * sin_a - lever * cos_a],
                [1.0 / base_m, -1.0 / base_m],
            ]
        )
        q = self._travel_variance * np.array([abs(right_m), abs(left_m)])
        grown = to_pose @ self._covariance @ to_pose.T + (to_travel * q) @ to_travel.T
        grown[2, 2] += reading_variance_rad2
        self._covariance = 0.5 * (grown + grown.T)
        return ds, dth

    def lose(self, duration_s: float) -> None:
        """The travel of `duration_s` is unknown: the pose stays, its covariance takes in what was possible.

        Each wheel may have had any speed between full back and full ahead, uniformly.
        """
        reach_m = FASTEST_MPS * max(duration_s, 0.0)
        variance_m2 = reach_m**2 / 3.0
        self._covariance = self._covariance + np.diag(
            [variance_m2, variance_m2, variance_m2 * 2.0 / self._wheel_base_m**2]
        )


def _sinc(x: float) -> float:
    return 1.0 - x * x / 6.0 if abs(x) < 1e-4 else math.sin(x) / x


class TwistWindow:
    """Speed over the last few samples, by their own stamps.

    One interval alone is too coarse (a count in 15 ms is 30 mm/s) and, divided by arrival times, spikes
    wherever a USB adapter delivers two frames at once. The answer is the mean over the window, so it lags a
    change of speed by half of it.
    """

    def __init__(self, samples: int = TWIST_SAMPLES) -> None:
        self._stamps: deque[int] = deque(maxlen=samples)
        self._travel: deque[tuple[float, float]] = deque(maxlen=samples - 1)

    def add(self, stamp_ns: int, ds_m: float, dth_rad: float) -> tuple[float, float, float]:
        """Take in the travel that ended at `stamp_ns`; returns m/s forward, m/s left (always 0), rad/s."""
        if self._stamps:
            self._travel.append((ds_m, dth_rad))
        self._stamps.append(stamp_ns)
        duration_s = (self._stamps[-1] - self._stamps[0]) * 1e-9
        if duration_s <= 0.0:
            return 0.0, 0.0, 0.0
        return (
            math.fsum(ds for ds, _ in self._travel) / duration_s,
            0.0,
            math.fsum(dth for _, dth in self._travel) / duration_s,
        )

    def clear(self) -> None:
        self._stamps.clear()
        self._travel.clear()
