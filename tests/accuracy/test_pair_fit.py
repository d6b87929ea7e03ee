"""What the distance of two scans from each other says, on two views of a room."""

import numpy as np

from tests.accuracy.pair_fit import mean_distance_m

WALL_M = np.arange(-4.0, 4.0, 0.05)
ROOM = np.vstack(  # two walls each way, m
    [np.column_stack([WALL_M, np.full_like(WALL_M, y)]) for y in (-3.0, 3.0)]
    + [np.column_stack([np.full_like(WALL_M, x), 0.75 * WALL_M]) for x in (-4.0, 4.0)]
)
POSE = np.array([0.4, -0.2, 0.3])


def seen_from(pose):
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return (ROOM - pose[:2]) @ np.array([[c, -s], [s, c]])


def test_scans_lie_on_each_other_at_their_true_relation():
    assert mean_distance_m(ROOM, seen_from(POSE), POSE) < 1e-9


def test_a_relation_that_is_5_cm_off_shows():
    off_m = mean_distance_m(ROOM, seen_from(POSE), np.add(POSE, (0.05, 0.0, 0.0)))
    assert 0.01 < off_m < 0.05  # the walls along x say nothing of x


def test_scans_that_share_nothing_say_nothing():
    assert np.isnan(mean_distance_m(ROOM, seen_from(POSE), np.add(POSE, (30.0, 0.0, 0.0))))
