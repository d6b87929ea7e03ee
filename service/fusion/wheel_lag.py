"""How late the stamps of the wheels are against those of the scans."""

import math
from collections import deque
from dataclasses import dataclass

from service.fusion.wheel_odometry import OdometryTrack
from service.geometry.se2 import wrap_angle

LEAST_NS = 100_000_000  # steps are joined until they are so long: one of 20 ms tells little
MOST_WAITING = 16
GATE_SIGMAS = 3.0
TURN_SHARE = 0.05  # of a turn: what wheels may be wrong by, besides their stamps
LEAST_NOISE_RAD2 = 1e-6  # of a comparison


@dataclass(frozen=True, slots=True)
class _Turn:
    """What matches say of a turn; sigma_rad: of the match at one end."""

    from_ns: int
    to_ns: int
    turn_rad: float
    sigma_rad: float


class WheelLag:
    """Learnt from turns that begin or end: shift the wheels by dt, and they turn by dt times the change of
    the rate more. Where the rate does not change nothing is learnt, and no lag would matter.

    sigma_s     of the lag before anything is learnt
    jitter_s    standard deviation of a single stamp
    most_s      a longer lag is not believed
    """

    def __init__(self, sigma_s: float, jitter_s: float, most_s: float) -> None:
        self._jitter_s = jitter_s
        self._most_s = most_s
        self._variance_s2 = sigma_s**2
        self._lag_s = 0.0
        self._joined: _Turn | None = None
        self._waiting: deque[_Turn] = deque(maxlen=MOST_WAITING)  # until the wheels have reported beyond them

    @property
    def lag_s(self) -> float:
        """What happened at t is reported with the stamp t + lag_s."""
        return self._lag_s

    @property
    def lag_ns(self) -> int:
        return round(self._lag_s * 1e9)

    @property
    def sigma_s(self) -> float:
        """Of when a sample was taken."""
        return math.hypot(self._jitter_s, math.sqrt(self._variance_s2))

    def learn(
        self, from_ns: int, to_ns: int, turn_rad: float, sigma_rad: float, track: OdometryTrack, scale: float
    ) -> None:
        """Take in a turn between two matches.

        sigma_rad   of the heading of a match
        scale       radians turned per radian that the wheels report
        """
        joined = self._joined
        if joined is not None and joined.to_ns == from_ns:
            from_ns, turn_rad = joined.from_ns, wrap_angle(joined.turn_rad + turn_rad)
        self._joined = turn = _Turn(from_ns, to_ns, turn_rad, sigma_rad)
        if to_ns - from_ns >= LEAST_NS:
            self._waiting.append(turn)
            self._joined = None
        while self._waiting and self._is_covered(self._waiting[0], track):
            self._compare(self._waiting.popleft(), track, scale)

    def _is_covered(self, turn: _Turn, track: OdometryTrack) -> bool:
        newest_ns = track.newest_ns
        return newest_ns is not None and turn.to_ns + self.lag_ns + LEAST_NS // 2 <= newest_ns

    def _compare(self, turn: _Turn, track: OdometryTrack, scale: float) -> None:
        from_ns, to_ns = turn.from_ns + self.lag_ns, turn.to_ns + self.lag_ns
        wheels_rad = track.turn_between(from_ns, to_ns)
        before, after = (track.turn_between(t - LEAST_NS // 2, t + LEAST_NS // 2) for t in (from_ns, to_ns))
        if wheels_rad is None or before is None or after is None:
            return
        rate_change = scale * (after - before) / (LEAST_NS * 1e-9)
        away_rad = wrap_angle(turn.turn_rad - scale * wheels_rad)
        noise = 2.0 * turn.sigma_rad**2 + (TURN_SHARE * wheels_rad) ** 2 + LEAST_NOISE_RAD2
        variance = noise + (self._jitter_s**2 + self._variance_s2) * rate_change**2
        if away_rad**2 > GATE_SIGMAS**2 * variance:
            return
        gain = self._variance_s2 * rate_change / variance
        self._lag_s = min(max(self._lag_s + gain * away_rad, -self._most_s), self._most_s)
        self._variance_s2 *= 1.0 - gain * rate_change
