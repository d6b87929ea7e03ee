"""Long drives go where they should, with as few scans as they should, and laps are counted right."""

from unittest.mock import Mock

import numpy as np
import pytest

from drivers.frames import LaserScan, OdometrySample
from service.geometry.se2 import SE2
from simulators.world import World
from tests.accuracy.long_drives import HALF_M, corridors, laps_of, slipping, thinned_drive
from tests.simulated import Run


@pytest.fixture(scope="module")
def world() -> World:
    return corridors(np.random.default_rng(11))


@pytest.mark.soak  # of the bench's own drives
def test_corridors_are_two_kilometres_and_driven_clear_of_their_walls(world: World) -> None:
    assert 2000.0 < world.drive.length_m < 2500.0
    places = world.drive.poses(np.arange(0.0, world.drive.duration_s, 10.0))[:, :2]
    begin, way = world.segments[:, :2], world.segments[:, 2:] - world.segments[:, :2]
    for place in places:
        share = np.clip(((place - begin) * way).sum(axis=1) / (way**2).sum(axis=1), 0.0, 1.0)
        assert np.hypot(*(begin + share[:, None] * way - place).T).min() > HALF_M - 0.7, place


@pytest.mark.soak  # of the bench's own drives
def test_another_seed_has_other_doors(world: World) -> None:
    assert not np.array_equal(corridors(np.random.default_rng(12)).segments[:50], world.segments[:50])


@pytest.mark.soak  # of the bench's own drives
def test_wheels_slip_now_and_then(world: World) -> None:
    slips = slipping(world, 11).slips
    assert len(slips) > 30
    assert slips == slipping(world, 11).slips
    assert min(slip.way_scale for slip in slips) < 0.2
    assert max(slip.way_scale for slip in slips) > 1.4


@pytest.mark.soak  # of the bench's own drives
def test_thinned_drive_has_a_scan_each_second_and_a_half() -> None:
    frames = thinned_drive(11, 30.0).frames
    scan_ns = [frame.stamp_ns for frame in frames if isinstance(frame, LaserScan)]
    odometry_ns = [frame.stamp_ns for frame in frames if isinstance(frame, OdometrySample)]
    assert set(np.diff(scan_ns)) == {1_500_000_000}
    assert set(np.diff(odometry_ns)) == {300_000_000}


@pytest.mark.soak  # of the bench's own drives
def test_error_of_a_lap_is_that_of_its_scans_and_sigma_rises_by_the_graph_alone() -> None:
    errors = np.zeros((40, 3))
    errors[20:, 0] = 0.01
    sigma_m = np.r_[np.full(25, 0.001), np.full(5, 0.003), np.full(10, 0.1)]
    outputs = [
        Mock(
            covariance=np.diag([sigma**2, 1e-8, 1e-8]),
            state="ok" if k < 36 else "degraded",
            pose_map_odom=SE2(0.1 if k >= 25 else 0.0),
        )
        for k, sigma in enumerate(sigma_m)
    ]
    laps = laps_of(Run(outputs, np.empty(0), Mock(), errors), np.arange(40.0), 10.0)
    assert laps.lap_mm == pytest.approx([0.0, 0.0, 10.0])
    assert laps.sigma_rise_mm == pytest.approx(2.0)
    assert laps.sigma_end_mm == pytest.approx(100.0)
    assert (laps.not_ok_percent, laps.wrong) == (10.0, 0.0)
