import numpy as np

from service.mapper.walls import walls_of

BEARING_RAD = np.radians(np.arange(-60.0, 60.0, 0.5))
AHEAD_M, SIGMA_M = 1.5, 0.04


def test_points_come_nearer_to_where_their_beams_meet_the_wall() -> None:
    """A wall across, seen from (0.2, 0)."""
    meets = np.column_stack((np.full(len(BEARING_RAD), AHEAD_M), AHEAD_M * np.tan(BEARING_RAD)))
    noise_m = np.random.default_rng(7).normal(0.0, SIGMA_M, len(BEARING_RAD))
    beams = np.column_stack((np.cos(BEARING_RAD), np.sin(BEARING_RAD)))
    sensor = np.array([0.2, 0.0])
    seen = sensor + meets + noise_m[:, None] * beams
    moved, normals = walls_of(seen, (0.2, 0.0), np.radians(0.5), SIGMA_M)
    off, off_before = (xy[:, 1] - meets[:, 1] for xy in (moved, seen))
    aslant = np.abs(BEARING_RAD) > 0.5
    assert np.std(off[aslant]) < 0.6 * np.std(off_before[aslant])
    np.testing.assert_allclose(moved[:, 0], seen[:, 0], atol=0.02)
    assert (normals[:, 0] < 0.0).all()  # towards the sensor
