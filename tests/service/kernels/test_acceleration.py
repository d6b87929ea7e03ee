"""An acceleration that fades: its transition over a time against the matrix exponential."""

from decimal import Decimal, localcontext

import pytest

from service.kernels import acceleration
from tests.service.kernels.inner import from_python

transition_over = from_python(acceleration.transition_over)


def exactly(dt: float, tau: float) -> list[float]:
    """The nine numbers by their closed forms, with digits enough for differences of near equals."""
    with localcontext() as context:
        context.prec = 80
        t, c = Decimal(dt), Decimal(tau)
        e = (-t / c).exp()
        ahead = t - c * (1 - e)
        numbers = [
            e,
            c * (1 - e),
            c * ahead,
            t**3 / 3 - c * t**2 + c**2 * t - 2 * c**2 * t * e + c**3 * (1 - e**2) / 2,
            ahead**2 / 2,
            c * (1 - e**2) / 2 - t * e,
            t - 2 * c * (1 - e) + c * (1 - e**2) / 2,
            (1 - e) ** 2 / 2,
            (1 - e**2) / (2 * c),
        ]
        return [float(number) for number in numbers]


@pytest.mark.parametrize("times", [1e-6, 1e-3, 0.03, 0.2, 0.999, 1.001, 3.0, 50.0])
def test_it_is_exact_however_short_or_long_the_time(times: float) -> None:
    over = transition_over(0.2 * times, 0.2)
    assert list(over) == pytest.approx(exactly(0.2 * times, 0.2), rel=1e-12, abs=0.0)
    assert list(transition_over(0.0, 0.2)) == [1.0] + 8 * [0.0]
