"""Transition and process noise of an acceleration with exponential correlation; [2], [3].

Numbers in brackets are those of docs/estimator.md. Source: Singer, Estimating optimal tracking filter
performance for manned maneuvering targets, IEEE Transactions on Aerospace and Electronic Systems 6, 1970.
"""

import math
from typing import NamedTuple

from service.kernels.compiled import inner_kernel

SHORT = 1.0  # in correlation times: below, differences of near equals are computed as power series
TERMS = 20  # of the series: the last is 1e-14 of the first


class Transition(NamedTuple):
    """Transition of twist and acceleration over a time step, with the integrated process noise."""

    kept: float  # factor on the acceleration
    to_twist_s: float  # change of speed = to_twist_s * acceleration
    to_step_s2: float  # displacement beyond constant speed = to_step_s2 * acceleration
    step_step: float  # variances over the density of [2]: s^3, s^2, s, s, 1, 1/s
    step_twist: float
    step_acceleration: float
    twist_twist: float
    twist_acceleration: float
    acceleration_acceleration: float


@inner_kernel
def transition_over(dt, tau):
    """The Transition over dt >= 0 s, for a correlation time tau > 0 s; [3]."""
    x = dt / tau
    e = math.exp(-x)
    gone = -math.expm1(-x)
    of_both = -0.5 * math.expm1(-2.0 * x)
    if x < SHORT:
        ahead = squared = crossed = carried = 0.0
        power = -x  # (-x)^n / n!
        two = 1.0  # 2^(n - 1)
        for n in range(2, TERMS + 1):
            power *= -x / n
            two *= 2.0
            ahead += power
            if n > 2:
                carried += power * (2.0 - two)
                crossed += power * (n - two)
            if n > 4:
                squared += power * (2.0 * n - two)
    else:
        ahead = x - gone
        carried = x - 2.0 * gone + of_both
        crossed = of_both - x * e
        squared = x * x * x / 3.0 - x * x + x - 2.0 * x * e + of_both
    return Transition(
        e,
        tau * gone,
        tau * tau * ahead,
        tau * tau * tau * squared,
        0.5 * tau * tau * ahead * ahead,
        tau * crossed,
        tau * carried,
        0.5 * gone * gone,
        of_both / tau,
    )
