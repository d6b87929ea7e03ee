import math

import numpy as np
import pytest

from service.kernels import match, surfel_equations, surfels
from service.kernels import scan_information as information_of_scans
from service.kernels.deskew import Returns
from service.kernels.filter_state import STUDENT
from service.kernels.likelihood import LikelihoodField, splat_likelihood
from service.kernels.likelihood_lm import thin_evenly
from service.kernels.match import MatchSettings, Prior, match_scan
from service.kernels.normals import estimate_normals
from service.kernels.surfels import SurfelGrid, insert_surfels
from service.mapper.matchers.field_align import align
from tests.service.kernels.inner import from_python
from tests.service.kernels.surfel_grids import empty_grid

find_surfels = from_python(surfels.find_surfels)

cost_at = from_python(match.cost_at)
align_on_surfels = from_python(match.align_on_surfels)
learn_twist = from_python(match.learn_twist)
empty_cache = from_python(surfels.empty_cache)
point_information = from_python(surfel_equations.point_information)
prior_weight_at = from_python(match.prior_weight_at)
surfel_cost = from_python(surfel_equations.surfel_cost)
surfel_normal_equations = from_python(surfel_equations.surfel_normal_equations)
scan_information = from_python(information_of_scans.scan_information)

SIGMA_M = 0.01  # of a range
SETTINGS = MatchSettings(
    range_sigma_m=SIGMA_M,
    surfel_sigma_m=SIGMA_M,
    wall_sigma_m=0.004,
    repeats=1.0,
    chance_chi2=0.0,
    information_chance_chi2=0.0,
    cauchy_m=0.1,
    least_normal_cosine=0.6,
    iterations=15,
    deskew_rounds=3,
    inlier_m=0.1,
    coarse_sigma=0.3,
    coarse_m=0.1,
    coarse_rad=0.05,
    coarse_beams=180,
    coarse_iterations=15,
    near=1.0,
    settled_m=1e-6,
    settled_rad=1e-7,
    degrees_of_freedom=STUDENT,
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
    prior = Prior(np.array(pose), np.zeros(3), sigma**2 * np.eye(3), 10.0 * np.eye(3))
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


def test_the_surfel_gradient_is_the_slope_of_its_cost() -> None:
    grid, xy = room_grid(), room_scan()
    normals, pose = normals_of(xy), np.array([0.03, -0.02, 0.015])
    found = np.empty((len(xy), 6))
    find_surfels(xy, normals, pose, grid, 0.6, found)
    matrix, shared, gradient = np.empty((3, 3)), np.empty((3, 3)), np.empty(3)

    def cost(at: np.ndarray) -> float:
        return surfel_cost(xy, normals, found, at, 0.15, SETTINGS)

    expected = slopes(cost, pose)
    surfel_normal_equations(
        xy, normals, found, pose, SETTINGS, matrix, shared, gradient, np.empty((len(xy), 7))
    )
    np.testing.assert_allclose(gradient, expected, rtol=1e-5)
    assert np.abs(expected).min() > 1.0


def test_the_hessian_is_that_of_weighted_least_squares() -> None:
    grid, xy = room_grid(), room_scan()
    normals, pose = normals_of(xy), np.array([0.03, -0.02, 0.015])
    found = np.empty((len(xy), 6))
    find_surfels(xy, normals, pose, grid, 0.6, found)
    matrix, shared, gradient = np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    used, inliers = surfel_normal_equations(
        xy, normals, found, pose, SETTINGS, matrix, shared, gradient, np.empty((len(xy), 7))
    )
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
        variance = SIGMA_M**2 / normal[2] + beside * (SIGMA_M**2 / n + 0.004**2)
        weight = 1.0 / variance / (1.0 + (e / 0.1) ** 2)
        expected += weight * np.outer(row, row)
        of_both += 0.5 * weight * (np.outer(row, other) + np.outer(other, row))
    np.testing.assert_allclose(matrix, expected, rtol=1e-9)
    np.testing.assert_allclose(shared, of_both, rtol=1e-9, atol=1e-6)
    assert used == np.count_nonzero(normals[:, 2])
    assert 0 < inliers <= used


def test_a_surfel_is_known_as_well_as_the_points_it_counts_not_as_those_of_this_scan() -> None:
    noisy = SETTINGS._replace(range_sigma_m=4.0 * SIGMA_M)
    assert point_information(1.0, 5.0, 1.0, noisy) == pytest.approx(
        1.0 / ((4.0 * SIGMA_M) ** 2 + SIGMA_M**2 / 5.0 + 0.004**2)
    )


def test_points_of_one_cell_share_the_error_of_its_wall() -> None:
    """However many they are, they do not know the wall better than it is known."""
    settings = SETTINGS._replace(repeats=3.0)
    alone = point_information(1.0, 5.0, 1.0, settings)
    assert alone == pytest.approx(1.0 / (SIGMA_M**2 + 3.0 * SIGMA_M**2 / 5.0 + 0.004**2))
    many = 1000
    together = many * point_information(1.0, 5.0, float(many), settings)
    assert together == pytest.approx(1.0 / (SIGMA_M**2 / many + 3.0 * SIGMA_M**2 / 5.0 + 0.004**2))
    assert together < 3.0 * alone
    assert point_information(1.0, 50.0, 20.0, settings) > 2.0 * point_information(1.0, 5.0, 20.0, settings)
    assert point_information(5.0, 50.0, 1.0, settings) > point_information(1.0, 50.0, 1.0, settings)


def test_where_both_normals_agree_the_information_is_the_hessian() -> None:
    root = np.random.default_rng(2).normal(size=(3, 3))
    hessian = 1e4 * (root @ root.T + np.eye(3))
    damping, information = np.empty((3, 3)), np.empty((3, 3))
    scan_information(hessian, hessian, NO_EVIDENCE, 0.0, damping, information)
    np.testing.assert_allclose(damping, np.eye(3), atol=1e-6)
    np.testing.assert_allclose(information, hessian, rtol=1e-5)
    scan_information(hessian, 0.5 * hessian, NO_EVIDENCE, 0.0, damping, information)
    np.testing.assert_allclose(information, 0.25 * hessian, rtol=1e-5)
    scan_information(
        hessian, -0.5 * hessian, NO_EVIDENCE, 0.0, damping, information
    )  # chance alone makes it negative
    np.testing.assert_allclose(information, 0.0, atol=1e-3)
    scan_information(hessian, 1.5 * hessian, NO_EVIDENCE, 0.0, damping, information)
    np.testing.assert_allclose(information, hessian, rtol=1e-5)


def test_a_prediction_that_is_far_off_loses_weight() -> None:
    information = np.diag([100.0, 400.0, 2500.0])

    def weight(x: float, y: float, turn: float) -> float:
        pose, prior_pose = np.array([x, y, turn]), np.array([0.0, 0.0, math.pi])
        return prior_weight_at(pose, prior_pose, information, STUDENT)

    assert weight(0.0, 0.0, -math.pi) == 1.0
    assert weight(0.1, 0.05, math.pi + 0.01) == 1.0
    weights = [weight(0.1 * sigmas, 0.0, math.pi) for sigmas in (2.0, 4.0, 8.0, 16.0)]
    assert weights == pytest.approx([8.0 / (5.0 + sigmas**2) for sigmas in (2.0, 4.0, 8.0, 16.0)])
    assert weight(0.0, 0.4, math.pi) == pytest.approx(weights[2])
    far = np.array([1.6, 0.0, math.pi])
    assert prior_weight_at(far, np.array([0.0, 0.0, math.pi]), information, 1e9) == pytest.approx(1.0)


def test_a_scan_finds_its_pose_to_a_fifth_of_a_millimetre() -> None:
    """Windows beside the corners of a room hold a point of the other wall within noise, and err by that."""
    truth = (0.21, -0.13, 0.08)
    result = match(room_scan(truth), prior_at((0.15, -0.08, 0.05)), room_grid())
    np.testing.assert_allclose(result.pose, truth, atol=2e-4)
    assert result.share > 0.95
    assert result.used > 600


def test_whole_cells_draw_a_scan_near_and_finer_ones_align_it() -> None:
    """The prediction is off by more than finer cells reach; full cells give the inlier ratio."""
    fine_grid = room_grid(0.05, beside_m=0.01)
    truth = (0.21, -0.13, 0.08)
    result = match(room_scan(truth), prior_at((0.11, -0.05, 0.03)), room_grid(), fine_grid=fine_grid)
    np.testing.assert_allclose(result.pose, (truth[0] + 0.01, *truth[1:]), atol=4e-4)
    assert result.share > 0.95


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


def test_no_step_of_a_doubtful_match_raises_the_cost() -> None:
    """A step may take points to where the map knows nothing: without a surfel they pull no longer."""
    grid, rng = room_grid(), np.random.default_rng(1)
    for _ in range(40):
        truth, start = rng.uniform(-0.5, 0.5, 3), rng.uniform(-0.8, 0.8, 3)
        begun, ended = costs_of_match(room_scan(tuple(truth)), start, grid)
        assert ended <= begun


def test_what_leaves_a_good_prediction_along_hedges_costs_less() -> None:
    """By noise of its normals a scan seems to fix the position along them; a step by it may lead anywhere."""
    sigma_m = 0.027  # as such a scan shows it, by second differences
    rng, grid = np.random.default_rng(3), empty_grid(tiles_each_way=20)
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


def costs_of_match(xy: np.ndarray, start: np.ndarray, grid: SurfelGrid) -> tuple[float, float]:
    """Half the cost at the start and end of a match in doubt; the prior is weak."""
    prior, information = prior_at((0.0, 0.0, 0.0), sigma=1.0), np.eye(3)
    normals, around, found = normals_of(xy), empty_cache(len(xy)), np.empty((len(xy), 6))

    def cost(pose: np.ndarray) -> float:
        return cost_at(xy, normals, pose, prior, information, grid, SETTINGS, 0.0, around, found)

    begun, pose = cost(start), start.copy()
    returns = Returns(xy, np.zeros(len(xy)), np.arange(len(xy), dtype=np.int32))
    out = np.eye(3), np.eye(3)
    align_on_surfels(
        returns,
        normals,
        prior,
        information,
        grid,
        SETTINGS,
        1.0,
        math.inf,
        0.0,
        around,
        xy.copy(),
        pose,
        *out,
    )
    return begun, cost(pose)


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


def test_the_coarse_step_alone_comes_within_centimetres() -> None:
    truth = np.array([0.3, -0.2, 0.1])
    grid = room_grid()
    field = LikelihoodField(grid.tiles, grid.field, grid.cell_m)
    thin = thin_evenly(room_scan(tuple(truth)), SETTINGS.coarse_beams, SETTINGS.coarse_sigma)
    pose = align(*thin, (np.zeros(3), np.eye(3)), field, np.zeros(3), SETTINGS.coarse_iterations)
    np.testing.assert_allclose(pose, truth, atol=0.04)


def test_a_correction_of_the_pose_corrects_the_twist() -> None:
    gain = np.array([[5.0, 0.0, 0.0], [0.0, 2.0, 0.0], [1.0, 0.0, 5.0]])
    prior = prior_at((1.0, 2.0, math.pi / 2.0), twist=np.array([1.0, 0.0, 0.2]), twist_gain=gain)
    twist, ahead = np.empty(3), np.array([1.0, 2.02, math.pi / 2.0 + 0.01])
    learn_twist(prior, ahead, 1.0, twist)
    np.testing.assert_allclose(twist, [1.1, 0.0, 0.27], atol=1e-12)
    learn_twist(prior, ahead, 0.5, twist)
    np.testing.assert_allclose(twist, [1.05, 0.0, 0.235], atol=1e-12)
    learn_twist(prior, np.array([9.0, 9.0, 9.0]), 0.0, twist)
    np.testing.assert_allclose(twist, prior.twist)


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


def test_chance_along_a_bare_corridor_does_not_add_up() -> None:
    """Limited to 0 or more, noise of zero mean becomes information; of fifty scans in a metre it is large."""
    seeds = range(20)
    all_of_it = np.array([information_in(99.0, seed)[1] for seed in seeds])
    less_chance = np.array([information_in(99.0, seed, 2.0 * math.log(50.0))[1] for seed in seeds])
    assert less_chance[:, 0, 0].mean() < 0.2 * all_of_it[:, 0, 0].mean()
    assert less_chance[:, 1, 1].min() > 0.99 * all_of_it[:, 1, 1].min()
    assert less_chance[:, 2, 2].min() > 0.99 * all_of_it[:, 2, 2].min()


def test_a_match_may_follow_what_its_information_leaves_out() -> None:
    """Where nothing but scans measures the motion, chance is followed and still called chance."""
    information = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        grid, xy = corridor_grid(99.0, rng, scans=5), corridor(99.0, rng)
        all_of_it, less_chance = (
            match(xy, prior_at((0.0, 0.0, 0.0)), grid, settings=settings)
            for settings in (SETTINGS, SETTINGS._replace(information_chance_chi2=2.0 * math.log(50.0)))
        )
        assert np.array_equal(all_of_it.pose, less_chance.pose)
        assert np.array_equal(all_of_it.covariance, less_chance.covariance)
        assert less_chance.weakest_sigma_m**-2 <= all_of_it.weakest_sigma_m**-2 + 1e-6
        information.append((all_of_it.information[0, 0], less_chance.information[0, 0]))
    followed, known = np.mean(information, axis=0)
    assert known < 0.2 * followed


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_information_of_a_visible_end_is_not_chance(seed: int) -> None:
    all_of_it = information_in(5.0, seed)[1]
    less_chance = information_in(5.0, seed, 2.0 * math.log(50.0))[1]
    np.testing.assert_allclose(np.diag(less_chance), np.diag(all_of_it), rtol=0.02)


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


def test_covariance_shrinks_with_what_the_walls_tell() -> None:
    prior = prior_at((0.0, 0.0, 0.0))
    result = match(room_scan(), prior, room_grid())
    eigenvalues = np.linalg.eigvalsh(result.covariance)
    assert eigenvalues[0] > 0.0
    assert np.sqrt(eigenvalues[-1]) < 0.01
    assert result.weakest_sigma_m < 0.01
