import math
from dataclasses import replace

import numpy as np
import pytest

from service.geometry.se2 import SE2
from service.kernels.blurred_segments import NO_SEGMENT
from service.mapper.components import Points
from service.mapper.matchers.field_align import information_at, values_at
from service.mapper.papers.owolm_eskf.across_walls import information_across, information_of_dots
from service.mapper.papers.owolm_eskf.orthogonal_map import OrthogonalMap, OrthogonalMapConfig
from tests.service.mapper.drives import BEAMS, CORRIDOR, FIRST_RAD, ROOM, STEP_RAD, cast
from tests.service.mapper.maps.points import match_at, points_of

END = [(9.0, -1.0, 9.0, 1.0)]


def seen(walls: list, x_m: float, y_m: float, theta_rad: float, seed: int, sigma_m: float = 0.01) -> Points:
    """541 beams of a laser at a pose, those of more than 20 m left out."""
    bearing = FIRST_RAD + STEP_RAD * np.arange(BEAMS)
    paths = np.stack((np.cos(bearing + theta_rad), np.sin(bearing + theta_rad)), axis=1)
    range_m = cast(walls, np.tile((x_m, y_m), (BEAMS, 1)), paths)
    range_m += sigma_m * np.random.default_rng(seed).standard_normal(BEAMS)
    is_seen = range_m < 20.0
    xy = range_m[is_seen, None] * np.stack((np.cos(bearing), np.sin(bearing)), axis=1)[is_seen]
    points = points_of(xy)
    return points._replace(scan=replace(points.scan, angle_step_rad=STEP_RAD), range_sigma_m=sigma_m)


def informations(walls: list, theta_rad: float = 0.0, sigma_m: float = 0.01, **config: object) -> tuple:
    """Of a scan aligned with the map of another from the same place: across walls, and as the slopes of the
    map have it, (3, 3) each, in the axes of the map; and which segments its points are in.
    """
    begun, aligned = (seen(walls, 0.0, 0.1, theta_rad, seed, sigma_m) for seed in (1, 2))
    local_map = OrthogonalMap(OrthogonalMapConfig.model_validate({"align_axes": False, **config}))
    at = SE2(0.0, 0.1, theta_rad)
    local_map.insert(begun, match_at(at, begun))
    pose, weights = np.array([0.0, 0.1, theta_rad]), np.ones(len(aligned.xy_base))
    c, s = math.cos(theta_rad), math.sin(theta_rad)
    xy_map = aligned.xy_base @ np.array([[c, s], [-s, c]]) + pose[:2]
    segment = local_map.segments(xy_map, local_map.gaps(aligned))
    field = local_map.field()
    across = information_across(aligned, values_at(aligned.xy_base, pose, field), weights, segment, pose)
    return across, information_at(aligned.xy_base, weights, pose, field), segment


def sigma_m(information: np.ndarray, axis: int) -> float:
    return math.sqrt(np.linalg.inv(information + 1e-9 * np.eye(3))[axis, axis])


@pytest.mark.parametrize("theta_rad", [0.0, 0.6])
@pytest.mark.parametrize("noise_m", [0.01, 0.04])
@pytest.mark.parametrize("weigh_segments", [True, False])
def test_a_bare_corridor_says_nothing_of_the_position_along_it(theta_rad, noise_m, weigh_segments) -> None:
    across, slopes, _segment = informations(CORRIDOR, theta_rad, noise_m, weigh_segments=weigh_segments)
    assert sigma_m(across, 0) > 50.0 * sigma_m(across, 1)
    assert sigma_m(slopes, 0) < 10.0 * sigma_m(slopes, 1)  # what its dots seem to say


def test_a_room_whose_walls_run_askew_to_the_map_fixes_the_pose() -> None:
    turn = np.array([[0.8, 0.6], [-0.6, 0.8]])
    askew = (np.array(ROOM).reshape(-1, 2) @ turn).reshape(-1, 4).tolist()
    across, slopes, segment = informations(askew)
    assert (segment == NO_SEGMENT).all()
    for axis in (0, 1):
        assert sigma_m(across, axis) < 2.0 * sigma_m(slopes, axis)


def dots(walls: list, noise_m: float = 0.01) -> np.ndarray:
    begun, aligned = (seen(walls, 0.0, 0.1, 0.0, seed, noise_m) for seed in (1, 2))
    local_map = OrthogonalMap(OrthogonalMapConfig(align_axes=False))
    local_map.insert(begun, match_at(SE2(0.0, 0.1, 0.0), begun))
    pose, weights = np.array([0.0, 0.1, 0.0]), np.ones(len(aligned.xy_base))
    segment = local_map.segments(aligned.xy_base + pose[:2], local_map.gaps(aligned))
    return information_of_dots(
        aligned, values_at(aligned.xy_base, pose, local_map.field()), weights, segment, pose
    )


def test_dots_beside_no_wall_count_in_both_directions() -> None:
    posts = [(x, y, x, y + 0.1) for x in (2.0, 3.0, 4.0, 6.0) for y in (0.4, -0.5)]
    assert sigma_m(dots(CORRIDOR + posts), 0) < 1.0
    assert sigma_m(informations(CORRIDOR + posts)[0], 0) > 100.0
