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


def test_one_that_fades_at_once_is_white_noise() -> None:
    dt = 0.04
    over = transition_over(dt, 1e-9)
    assert over.step_step == pytest.approx(dt**3 / 3.0, rel=1e-6)
    assert over.step_twist == pytest.approx(dt**2 / 2.0, rel=1e-6)
    assert over.twist_twist == pytest.approx(dt, rel=1e-6)
    assert over.kept == 0.0


def test_two_steps_are_one() -> None:
    short, long = transition_over(0.05, 0.2), transition_over(0.1, 0.2)
    assert long.kept == pytest.approx(short.kept**2)
    assert long.to_twist_s == pytest.approx(short.to_twist_s * (1.0 + short.kept))
    assert long.to_step_s2 == pytest.approx(short.to_step_s2 * (1.0 + short.kept) + 0.05 * short.to_twist_s)
