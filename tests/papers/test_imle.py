"""What the first scan of a room is worth."""

import numpy as np

from tests.papers.imle import FAR_BEAMS, IN_ROOM_M, MODEL, worst_is_beyond


def test_chance_of_a_worst_seed_agrees_with_drawn_distances() -> None:
    noise_m = MODEL.sigma_m * np.random.default_rng(1).standard_normal((20_000, 10, FAR_BEAMS))
    worst_m = np.abs(noise_m.mean(axis=2)).max(axis=1)
    np.testing.assert_allclose(worst_is_beyond(10), (worst_m > IN_ROOM_M).mean(), atol=0.01)
