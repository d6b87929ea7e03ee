import numpy as np
import pytest

from service.kernels.particles import normalise_weights, resample


def test_weights_add_up_and_their_worth_is_counted() -> None:
    log_weights, weights = np.array([-2000.0, -2000.0 + np.log(3.0), -3000.0]), np.empty(3)
    worth = normalise_weights(log_weights, weights)
    np.testing.assert_allclose(weights, [0.25, 0.75, 0.0], atol=1e-12)
    assert worth == pytest.approx(1 / (0.25**2 + 0.75**2))
    assert log_weights.max() == 0.0
    assert normalise_weights(np.zeros(30), np.empty(30)) == pytest.approx(30.0)


# D2
@pytest.mark.parametrize("first", [0.0, 0.3, 0.999])
def test_each_particle_is_resampled_by_its_weight(first: float) -> None:
    """Low variance: never off by one copy or more."""
    weights = np.random.default_rng(1).dirichlet(np.full(30, 0.3))
    chosen = np.empty(30, np.int64)
    resample(weights, first, chosen)
    assert (np.diff(chosen) >= 0).all()
    copies = np.bincount(chosen, minlength=30)
    assert (np.abs(copies - 30 * weights) < 1.0).all()


def test_equal_weights_change_nothing_and_rounding_loses_no_one() -> None:
    chosen = np.empty(10, np.int64)
    resample(np.full(10, 0.1), 0.5, chosen)
    np.testing.assert_array_equal(chosen, np.arange(10))
    resample(np.full(10, 0.0999999), 0.9999999, chosen)
    assert chosen[-1] == 9
