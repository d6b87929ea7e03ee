"""NEES is 3 where errors are what the covariances say."""

from unittest.mock import Mock

import numpy as np
import pytest

from tests.accuracy.consistency import EXPECTED, nees_of
from tests.simulated import Run


def test_errors_as_their_covariance_says_have_the_nees_that_is_expected() -> None:
    rng = np.random.default_rng(1)
    covariance = np.array([[4e-4, 1e-4, 0.0], [1e-4, 9e-4, -1e-5], [0.0, -1e-5, 1e-6]])
    errors = rng.multivariate_normal(np.zeros(3), covariance, 5000)
    outputs = [Mock(covariance=covariance) for _ in errors]
    assert nees_of(Run(outputs, np.empty(0), Mock(), errors)) == pytest.approx(EXPECTED, rel=0.1)
    assert nees_of(Run(outputs, np.empty(0), Mock(), 2.0 * errors)) == pytest.approx(4.0 * EXPECTED, rel=0.1)


def test_the_first_tenth_of_a_drive_is_left_out() -> None:
    errors = np.zeros((100, 3))
    errors[:10] = 1.0
    outputs = [Mock(covariance=np.eye(3)) for _ in errors]
    assert nees_of(Run(outputs, np.empty(0), Mock(), errors)) == 0.0
