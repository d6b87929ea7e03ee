"""What matches teach about the wheels: how far they really roll, and how far they turn."""

import math
from dataclasses import dataclass

from service.geometry.se2 import SE2

STRANGE_LIMIT = 3
WALK = 0.0005  # how much a factor may change from one window to the next: floors and loads do


@dataclass(slots=True)
class LearntScale:
    """A factor close to 1, learnt from pairs of what was measured and what was true.

    sigma         of the factor; sets how much a new pair counts
    strange       pairs in a row that fit badly; a few are slip, more are another floor
    """

    sigma: float
    value: float = 1.0
    strange: int = 0

    def learn(self, measured: float, true: float, sigma: float) -> None:
        """Take in a window. sigma: of true, in its unit."""
        noise = (sigma / measured) ** 2
        self.sigma = math.hypot(self.sigma, WALK)
        away = true / measured - self.value
        if away * away > 9.0 * (self.sigma**2 + noise):
            self.strange += 1
            if self.strange < STRANGE_LIMIT:
                return
            self.sigma = max(self.sigma, abs(away))
        self.strange = 0
        gain = self.sigma**2 / (self.sigma**2 + noise)
        self.value += gain * away
        self.sigma *= math.sqrt(1.0 - gain)


@dataclass(slots=True)
class _Window:
    """Sums up steps until there is enough way to compare."""

    measured: float = 0.0
    true: float = 0.0
    variance: float = 0.0  # of the match at one end
    noise: float = 0.0  # variance of the wheels over the window

    def collect(
        self,
        scale: LearntScale,
        pair: tuple[float, float],
        sigma: float | None,
        noise: float,
        enough: float,
    ) -> None:
        """Add a step, measured and true; when there is enough, teach it to the scale and begin anew."""
        if sigma is not None:
            self.measured += pair[0]
            self.true += pair[1]
            self.variance = max(self.variance, sigma * sigma)
            self.noise += noise
            if abs(self.measured) < enough:
                return
            scale.learn(self.measured, self.true, math.sqrt(2.0 * self.variance + self.noise))
        self.measured = self.true = self.variance = self.noise = 0.0


class WheelTrust:
    """Learns from matches whose direction the walls fix; else waits.

    window_m, window_rad    a pair is taken after so much way or turn
    scale_sigma             of both factors before anything is learnt
    walk                    noise of the wheels, m and rad per square root of a metre or radian
    """

    LEAST_SCALE, MOST_SCALE = 0.5, 2.0

    def __init__(
        self,
        window_m: float,
        window_rad: float,
        scale_sigma: float,
        walk: tuple[float, float],
    ) -> None:
        self._window_m = window_m
        self._window_rad = window_rad
        self._way = LearntScale(scale_sigma)
        self._turn = LearntScale(scale_sigma)
        self._walk = walk
        self._way_window = _Window()
        self._turn_window = _Window()

    @property
    def scale(self) -> float:
        """Metres driven per metre that the wheels report."""
        return self._way.value

    @property
    def turn_scale(self) -> float:
        return self._turn.value

    @property
    def scale_sigma(self) -> float:
        return self._way.sigma

    def corrected(self, way: SE2) -> SE2:
        """A way as the wheels should have reported it."""
        forward, left, turn = way.log()
        return SE2.exp(self.scale * forward, self.scale * left, self.turn_scale * turn)

    def learn(self, way: SE2, matched: SE2, sigma_m: float | None, sigma_rad: float | None) -> None:
        """Take in what wheels and walls say of the way between two matches.

        sigma_m, sigma_rad   of the match, along the way and of the turn; None where the walls do not say
        """
        forward, _, turn = way.log()
        true_forward, _, true_turn = matched.log()
        way_walk, turn_walk = self._walk
        way_noise = way_walk**2 * abs(forward)
        turn_noise = turn_walk**2 * (abs(forward) + abs(turn))
        self._way_window.collect(self._way, (forward, true_forward), sigma_m, way_noise, self._window_m)
        self._turn_window.collect(self._turn, (turn, true_turn), sigma_rad, turn_noise, self._window_rad)
        for scale in (self._way, self._turn):
            scale.value = min(max(scale.value, self.LEAST_SCALE), self.MOST_SCALE)
