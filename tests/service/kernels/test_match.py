import math

import numpy as np
import pytest

from service.kernels import scan_information as information_of_scans
from service.kernels import surfel_equations, surfels
from service.kernels.deskew import Returns
from service.kernels.likelihood import splat_likelihood
from service.kernels.match import MatchSettings, Prior, match_scan
from service.kernels.normals import estimate_normals
from service.kernels.surfels import SurfelGrid, insert_surfels
from service.mapper.graph.model.point_clouds import ALIGNMENT
from tests.service.kernels.grids import empty_grid
from tests.service.kernels.inner import from_python

find_surfels = from_python(surfels.find_surfels)

surfel_cost = from_python(surfel_equations.surfel_cost)
surfel_normal_equations = from_python(surfel_equations.surfel_normal_equations)
scan_information = from_python(information_of_scans.scan_information)

SIGMA_M = 0.01  # of a range
SETTINGS = ALIGNMENT._replace(
    range_sigma_m=SIGMA_M, surfel_sigma_m=SIGMA_M, wall_sigma_m=0.004, settled_m=1e-6, settled_rad=1e-7
)
STEP_RAD = math.radians(0.5)
NO_EVIDENCE = np.zeros((0, 7))


def room_scan(pose: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> np.ndarray:
    """End points, in the base frame, of beams all around in a room of x -3..4, y -2..2.5."""
    angle = np.arange(-math.pi, math.pi, STEP_RAD)
    c, s = np.cos(angle + pose[2]), np.sin(angle + pose[2])
    with np.errstate(divide="ignore"):
        along_x = np.where(c > 0.0, 4.0 - pose[0], -3.0 - pose[0]) / c
        along_y = np.where(s > 0.0, 2.5 - pose[1], -2.0 - pose[1]) / s
    return np.minimum(along_x, along_y)[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])


def normals_of(xy: np.ndarray, sigma_m: float = SIGMA_M) -> np.ndarray:
    normals = np.empty((len(xy), 3))
    estimate_normals(xy, np.zeros(2), STEP_RAD, sigma_m, 5.0, normals, np.empty((len(xy), 2)))
    return normals


def room_grid(cell_m: float = 0.1, beside_m: float = 0.0) -> SurfelGrid:
    """beside_m: offset of the room along x."""
    grid = empty_grid(cell_m)
    xy, pose = room_scan(), np.array([beside_m, 0.0, 0.0])
    for _ in range(3):
        insert_surfels(xy, normals_of(xy), pose, grid, 50.0, 1.0, np.zeros(2), -1)
    splat_likelihood(xy, pose, grid, 0.15, 0.95)
    return grid


def prior_at(pose: tuple[float, float, float], sigma: float = 0.1, **changes: object) -> Prior:
    prior = Prior(np.array(pose), np.zeros(3), sigma**2 * np.eye(3), 10.0 * sigma**2 * np.eye(3))
    return prior._replace(**changes)


def match(
    xy: np.ndarray,
    prior: Prior,
    grid: SurfelGrid,
    doubt_inlier_ratio: float = 0.8,
    fine_grid: SurfelGrid | None = None,
    settings: MatchSettings = SETTINGS,
):
    """fine_grid: None: the same."""
    return match_scan(
        Returns(xy, np.zeros(len(xy)), np.arange(len(xy), dtype=np.int32)),
        normals_of(xy, settings.range_sigma_m),
        prior,
        prior.pose,
        grid,
        grid if fine_grid is None else fine_grid,
        settings,
        doubt_inlier_ratio,
        xy.copy(),
    )


def slopes(cost, pose: np.ndarray) -> np.ndarray:
    """Gradient by central differences."""
    steps = 1e-6 * np.eye(3)
    return np.array([(cost(pose + step) - cost(pose - step)) / 2e-6 for step in steps])


def test_the_gradient_is_the_slope_of_the_cost_and_the_hessian_that_of_weighted_least_squares() -> None:
    settings = SETTINGS._replace(range_sigma_m=2.0 * SIGMA_M, repeats=3.0)
    grid, xy = room_grid(), room_scan()
    normals, pose = normals_of(xy), np.array([0.03, -0.02, 0.015])
    found = np.empty((len(xy), 6))
    find_surfels(xy, normals, pose, grid, 0.6, found)
    matrix, shared, gradient = np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    used, inliers = surfel_normal_equations(
        xy, normals, found, pose, settings, matrix, shared, gradient, np.empty((len(xy), 7))
    )
    slope = slopes(lambda at: surfel_cost(xy, normals, found, at, 0.15, settings), pose)
    np.testing.assert_allclose(gradient, slope, rtol=1e-5)
    assert np.abs(slope).min() > 1.0

    c, s = math.cos(pose[2]), math.sin(pose[2])
    turn = np.array([[c, -s], [s, c]])
    expected, of_both = np.zeros((3, 3)), np.zeros((3, 3))
    for point, normal, (mx, my, nx, ny, n, beside) in zip(xy, normals, found, strict=True):
        if normal[2] == 0.0 or n == 0.0:
            continue
        rx, ry = turn @ point
        e = nx * (pose[0] + rx - mx) + ny * (pose[1] + ry - my)
        own = turn @ normal[:2]
        row = np.array([nx, ny, ny * rx - nx * ry])
        other = np.array([*own, own[1] * rx - own[0] * ry])
        # Points of one cell and of scans that follow closely share the error of its wall.
        variance = (2.0 * SIGMA_M) ** 2 / normal[2] + beside * (3.0 * SIGMA_M**2 / n + 0.004**2)
        weight = 1.0 / variance / (1.0 + (e / 0.1) ** 2)
        expected += weight * np.outer(row, row)
        of_both += 0.5 * weight * (np.outer(row, other) + np.outer(other, row))
    np.testing.assert_allclose(matrix, expected, rtol=1e-9)
    np.testing.assert_allclose(shared, of_both, rtol=1e-9, atol=1e-6)
    assert used == np.count_nonzero(normals[:, 2])
    assert 0 < inliers <= used


@pytest.mark.parametrize(("share", "believed"), [(1.0, 1.0), (0.5, 0.25), (-0.5, 0.0), (1.5, 1.0)])
def test_the_information_is_the_hessian_as_far_as_both_normals_agree(share: float, believed: float) -> None:
    root = np.random.default_rng(2).normal(size=(3, 3))
    hessian = 1e4 * (root @ root.T + np.eye(3))
    damping, information = np.empty((3, 3)), np.empty((3, 3))
    scan_information(hessian, share * hessian, NO_EVIDENCE, 0.0, damping, information)
    np.testing.assert_allclose(information, believed * hessian, rtol=1e-5, atol=1e-3)


def test_a_scan_finds_its_pose_to_a_fifth_of_a_millimetre() -> None:
    """Windows beside the corners of a room hold a point of the other wall within noise, and err by that."""
    truth = (0.21, -0.13, 0.08)
    result = match(room_scan(truth), prior_at((0.15, -0.08, 0.05)), room_grid())
    np.testing.assert_allclose(result.pose, truth, atol=2e-4)
    assert result.share > 0.95
    assert result.used > 600


def test_where_few_inliers_lie_on_finer_surfels_full_cells_decide() -> None:
    truth = (0.21, -0.13, 0.08)
    fine_grid = empty_grid(0.05)
    xy = room_scan()
    part = xy[np.abs(xy[:, 0] - 0.5) < 1.2]  # 50 % of the room, and it seems to be elsewhere
    pose = np.array([0.01, 0.01, 0.0])
    insert_surfels(part, normals_of(part), pose, fine_grid, 50.0, 1.0, np.zeros(2), -1)
    prior, scan = prior_at((0.15, -0.08, 0.05)), room_scan(truth)
    result = match(scan, prior, room_grid(), fine_grid=fine_grid)
    without = match(scan, prior, room_grid(), fine_grid=empty_grid(0.05))
    np.testing.assert_allclose(result.pose, truth, atol=4e-4)
    assert np.array_equal(result.pose, without.pose)
    assert np.array_equal(result.covariance, without.covariance)


def test_what_leaves_a_good_prediction_along_hedges_costs_less() -> None:
    """By noise of its normals a scan seems to fix the position along them; a step by it may lead anywhere."""
    sigma_m = 0.027  # as such a scan shows it, by second differences
    rng, grid = np.random.default_rng(3), empty_grid(half_tiles=20)
    for x_m in np.arange(-3.0, 3.0, 0.06):
        xy = hedges(rng)
        insert_surfels(
            xy, normals_of(xy, sigma_m), np.array([x_m, 0.0, 0.0]), grid, 1000.0, 1.0, np.zeros(2), -1
        )
    settings = SETTINGS._replace(range_sigma_m=sigma_m, settled_m=5e-4, settled_rad=1e-4)
    covariance = np.diag([0.012, 0.003, 0.0015]) ** 2
    for _ in range(100):
        xy, begun = hedges(rng), np.array([rng.uniform(-1.0, 1.0), 0.0, 0.0])
        prior = Prior(begun, np.zeros(3), covariance, np.zeros((3, 3)))
        result = match(xy, prior, grid, settings=settings)
        assert abs(result.pose[0] - begun[0]) < 0.1


def hedges(rng: np.random.Generator) -> np.ndarray:
    """Beams that end up to some tenths of a metre behind the first leaves of hedges at y -6 and 6."""
    angle = np.arange(-2.35, 2.35, STEP_RAD)
    with np.errstate(divide="ignore"):
        range_m = 6.0 / np.abs(np.sin(angle))
    angle, range_m = angle[range_m < 20.0], range_m[range_m < 20.0]
    range_m += np.abs(rng.normal(0.0, 0.1, len(angle)))
    return range_m[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])


def test_the_coarse_map_leads_where_the_surfels_are_out_of_reach() -> None:
    truth = (1.0, 0.5, 0.3)
    prior = prior_at((0.0, 0.0, 0.0), sigma=0.3)
    led = match(room_scan(truth), prior, room_grid())
    alone = match(room_scan(truth), prior, room_grid(), doubt_inlier_ratio=0.0)
    assert np.abs(alone.pose - truth).max() > 0.05
    np.testing.assert_allclose(led.pose, truth, atol=2e-3)


@pytest.mark.parametrize("turn_rad", [-0.15, -0.05, 0.05, 0.15])
def test_a_prediction_that_is_wrong_and_sure_of_it_holds_no_scan(turn_rad: float) -> None:
    """As by odometry that stands still while the vehicle begins to turn; sigma 0.2 mm and 0.01 deg."""
    truth = (0.0, 0.0, turn_rad)
    result = match(room_scan(truth), prior_at((0.0, 0.0, 0.0), sigma=2e-4), room_grid())
    np.testing.assert_allclose(result.pose, truth, atol=2e-3)
    assert result.prior_weight < 0.01


def test_a_scan_far_from_any_map_keeps_the_prediction_without_inliers() -> None:
    prior = prior_at((0.1, 0.2, 0.3))
    result = match(room_scan() + 100.0, prior, room_grid())
    np.testing.assert_allclose(result.pose, prior.pose, atol=1e-9)
    assert result.share == 0.0
    assert result.weakest_sigma_m == math.inf
    np.testing.assert_allclose(result.covariance, prior.covariance, rtol=1e-9, atol=1e-15)


def corridor(end_m: float, rng: np.random.Generator) -> np.ndarray:
    """Noisy walls at y -1 and 1, and one across at x = end_m."""
    angle = np.arange(-2.8, 2.8, STEP_RAD)
    angle = angle[(np.abs(angle) > 0.3) | (end_m < 20.0)]
    with np.errstate(divide="ignore"):
        to_end_m = np.where(np.cos(angle) > 0.0, end_m, 99.0) / np.abs(np.cos(angle))
        range_m = np.minimum(1.0 / np.abs(np.sin(angle)), to_end_m)
    range_m += rng.normal(0.0, SIGMA_M, len(angle))
    return range_m[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])


def corridor_grid(end_m: float, rng: np.random.Generator, scans: int = 25) -> SurfelGrid:
    grid = empty_grid()
    for _ in range(scans):
        xy = corridor(end_m, rng)
        insert_surfels(xy, normals_of(xy), np.zeros(3), grid, 1000.0, 1.0, np.zeros(2), -1)
        splat_likelihood(xy, np.zeros(3), grid, 0.15, 0.95)
    return grid


def information_in(end_m: float, seed: int, chance_chi2: float = 0.0) -> tuple[np.ndarray, np.ndarray, float]:
    """Hessian, and what is believed of it, at the true pose; mean square of the normals' x of the scan."""
    rng = np.random.default_rng(seed)
    grid, xy = corridor_grid(end_m, rng, scans=5), corridor(end_m, rng)
    normals, found = normals_of(xy), np.empty((len(xy), 6))
    find_surfels(xy, normals, np.zeros(3), grid, 0.6, found)
    hessian, shared, gradient, damping, information = (np.empty((3, 3)) for _ in range(5))
    evidence = np.empty((len(xy), 7))
    surfel_normal_equations(xy, normals, found, np.zeros(3), SETTINGS, hessian, shared, gradient[0], evidence)
    scan_information(hessian, shared, evidence, chance_chi2, damping, information)
    return hessian, information, float(np.mean(normals[:, 0] ** 2))


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_along_a_bare_corridor_noise_of_the_normals_has_little_information(seed: int) -> None:
    """Each of the two normals seems to fix the position; their product does not."""
    hessian, information, square = information_in(99.0, seed)
    own = square * hessian[1, 1]
    assert own > 2e4  # a sigma of 7 mm
    assert hessian[0, 0] > 300.0
    assert information[0, 0] < 0.1 * own
    assert information[0, 0] < 1e-3 * information[1, 1]
    assert information[1, 1] > 0.9 * hessian[1, 1]


def test_a_wall_across_the_corridor_is_believed() -> None:
    hessian, information, _ = information_in(3.0, 1)
    assert information[0, 0] > 0.8 * hessian[0, 0] > 1e5
    less_chance = information_in(3.0, 1, 2.0 * math.log(50.0))[1]
    np.testing.assert_allclose(np.diag(less_chance), np.diag(information), rtol=0.02)
    rng = np.random.default_rng(1)
    grid = corridor_grid(3.0, rng)
    result = match(corridor(3.0, rng), prior_at((0.05, 0.03, 0.02)), grid)
    assert result.pose[0] == pytest.approx(0.0, abs=0.01)
    assert result.weakest_sigma_m < 0.01


def test_along_a_bare_corridor_the_claimed_sigma_is_true() -> None:
    squares = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        grid = corridor_grid(99.0, rng)
        off_m = rng.normal(0.0, 0.1)
        result = match(corridor(99.0, rng), prior_at((off_m, 0.0, 0.0)), grid)
        squares.append(result.pose[0] ** 2 / result.covariance[0, 0])
    assert math.sqrt(np.mean(squares)) < 2.0
