"""Whether wheels and gyro agree with the walls at all; one that does not is left out until it does."""

import math
from dataclasses import dataclass

WINDOW_NS = 250_000_000  # what is compared: a single step at 50 Hz is too short to tell anything
BAD_SIGMAS = 3.0  # so far off, a window is a strike against the source
# A strike counts twice where the source is beyond the one, and the last speed gone on within the other.
VERY_BAD_SIGMAS, GOOD_SIGMAS = 3.6, 2.0
LONGEST_STEP_NS = 150_000_000  # over a longer one the last speed is no alternative to the poorest wheels
AT_ONCE_SIGMAS = 8.0  # ... without waiting for the end of the window
STRIKES_OUT = 2.0
STRIKES_MOST = 4.0
FORGIVEN = 0.1  # of a strike, for each window in which it was right about a motion

TWICE = math.sqrt(2.0)  # two matches, one at each end

Way = tuple[float, float]  # m forward, rad to the left
NOWHERE: Way = (0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Noise:
    """Standard deviations of what a source says over a window; inf where it says nothing."""

    m: float
    m_per_m: float
    rad: float
    rad_per_rad: float
    rad_per_m: float

    def of(self, way: Way) -> Way:
        forward_m, turn_rad = abs(way[0]), abs(way[1])
        return (
            self.m + self.m_per_m * forward_m,
            self.rad + self.rad_per_rad * turn_rad + self.rad_per_m * forward_m,
        )


class SourceTrust:
    """Of one source, measured by walls, and by what is left without it: the last speed gone on."""

    def __init__(self, noise: Noise) -> None:
        self._noise = noise
        self._strikes = 0.0
        self._out = False
        self._said: Way = NOWHERE
        self._found: Way = NOWHERE
        self._guessed: Way = NOWHERE
        self._from_ns: int | None = None
        self._against: tuple[Way, Way] = (NOWHERE, NOWHERE)  # said and found, in the last bad window

    @property
    def is_trusted(self) -> bool:
        return not self._out

    def begin_anew(self) -> None:
        """A scan was not matched, or the source was silent: the window so far means nothing."""
        self._from_ns = None

    def learn(self, from_ns: int, to_ns: int, said: Way, found: Way, guessed: Way, match_sigma: Way) -> None:
        """Take in the way between two matches: as the source, the walls, and the last speed have it.

        match_sigma   of a match, along the way and of the heading
        """
        if to_ns - from_ns > LONGEST_STEP_NS:
            self._from_ns = None
            return
        if self._from_ns is None:
            self._from_ns, self._said, self._found, self._guessed = from_ns, NOWHERE, NOWHERE, NOWHERE
        self._said = self._said[0] + said[0], self._said[1] + said[1]
        self._found = self._found[0] + found[0], self._found[1] + found[1]
        self._guessed = self._guessed[0] + guessed[0], self._guessed[1] + guessed[1]
        sigma = self._sigma(match_sigma)
        off, guess_off = (_sigmas(way, self._found, sigma) for way in (self._said, self._guessed))
        if off < AT_ONCE_SIGMAS and to_ns - self._from_ns < WINDOW_NS:
            return
        if off > max(BAD_SIGMAS, guess_off):
            is_plain = off > VERY_BAD_SIGMAS and guess_off < GOOD_SIGMAS
            self._strikes = min(self._strikes + (2.0 if is_plain else 1.0), STRIKES_MOST)
            self._against = self._said, self._found
        elif _sigmas(NOWHERE, self._found, sigma) > BAD_SIGMAS:
            self._strikes = max(self._strikes - FORGIVEN, 0.0)
        if self._strikes >= STRIKES_OUT:
            self._out = True
        elif self._strikes == 0.0:
            self._out = False
        self._from_ns = None

    def _sigma(self, match_sigma: Way) -> Way:
        """Of the difference between source and walls, over the window so far."""
        forward_m = max(abs(self._said[0]), abs(self._found[0]))
        turn_rad = max(abs(self._said[1]), abs(self._found[1]))
        own_m, own_rad = self._noise.of((forward_m, turn_rad))
        return math.hypot(own_m, TWICE * match_sigma[0]), math.hypot(own_rad, TWICE * match_sigma[1])

    def contradiction(self) -> str:
        """In words, what the source last said against what the walls did."""
        (said_m, said_rad), (found_m, found_rad) = self._against
        if math.isinf(self._noise.m):
            return f"{math.degrees(said_rad):.1f} deg against {math.degrees(found_rad):.1f} deg"
        return (
            f"{said_m:.2f} m and {math.degrees(said_rad):.1f} deg against "
            f"{found_m:.2f} m and {math.degrees(found_rad):.1f} deg"
        )


def _sigmas(a: Way, b: Way, sigma: Way) -> float:
    return max(abs(a[0] - b[0]) / sigma[0], abs(a[1] - b[1]) / sigma[1])
