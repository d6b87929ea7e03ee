import numpy as np
import pytest

from service.geometry.poses import moved_by
from service.geometry.se2 import SE2
from service.mapper.matchers.covariances import in_base_axes


@pytest.mark.parametrize("theta_rad", [0.3, -2.0])
def test_errors_sampled_in_the_map_scatter_so_in_base_axes(theta_rad: float) -> None:
    root = np.array([[0.2, 0.0, 0.0], [0.1, 0.05, 0.0], [0.0, 0.01, 0.02]])
    errors = np.random.default_rng(1).standard_normal((200_000, 3)) @ root.T
    seen = np.column_stack([moved_by(SE2(0.0, 0.0, -theta_rad), errors[:, :2]), errors[:, 2]])
    np.testing.assert_allclose(in_base_axes(root @ root.T, theta_rad), np.cov(seen.T), atol=4e-4)
