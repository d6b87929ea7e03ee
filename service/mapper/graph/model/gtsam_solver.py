"""Solves a pose graph by GTSAM; the only module that imports GTSAM."""

from collections.abc import Sequence
from functools import cache

import gtsam
import numpy as np

from service.geometry.poses import Floats
from service.mapper.graph.model.pose_graph import PoseGraph, SolverConfig, bearing_range

FIXED_SIGMA = 1e-5  # m and rad, of a fixed pose: above rounding
AUXILIARY_OFFSET_M = 4.0  # from a pose to its auxiliary pose, for points too near for a bearing
MIN_FACTOR_RANGE_M = 1.0  # a nearer point is measured from the auxiliary pose


def solve_with_fixed(
    graph: PoseGraph, fixed_poses: list[int], config: SolverConfig, covariances_of: Sequence[int]
) -> tuple[Floats, Floats, dict[int, Floats]]:
    """Poses (N, 3) m and rad, landmarks (L, 2) m, and covariances (3, 3) by index of the pose.

    fixed_poses   stay at the first guess
    Raises RuntimeError of GTSAM.
    """
    factors, values = _factors(graph, fixed_poses)
    values = _optimise(factors, values, config)
    poses, landmarks = _read(graph, values)
    marginals = gtsam.Marginals(factors, values) if len(covariances_of) else None
    covariances = {int(k): marginals.marginalCovariance(int(k)) for k in covariances_of if marginals}
    return poses, landmarks, covariances


def marginal_of(graph: PoseGraph, k: int) -> Floats:
    """(3, 3) marginal covariance of pose k against the fixed one, in its own axes, at the given poses.

    Raises RuntimeError of GTSAM.
    """
    settings = gtsam.ISAM2Params()
    settings.setFactorization("QR")  # gtsam.Marginals supports Cholesky only
    bayes_tree = gtsam.ISAM2(settings)
    bayes_tree.update(*_factors(graph, [graph.fixed]))
    return np.asarray(bayes_tree.marginalCovariance(k))


def _factors(graph: PoseGraph, fixed_poses: list[int]) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """Keys: poses 0..N-1, landmarks N..N+L-1, auxiliary poses from N+L on."""
    factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    pose_count, landmark_count = len(graph.poses), len(graph.landmarks)
    for k, pose in enumerate(graph.poses.tolist()):
        values.insert(k, gtsam.Pose2(*pose))
    for k, xy in enumerate(graph.landmarks):
        values.insert(pose_count + k, xy)
    tight = gtsam.noiseModel.Isotropic.Sigma(3, FIXED_SIGMA)
    for k in fixed_poses:
        factors.add(gtsam.PriorFactorPose2(k, gtsam.Pose2(*graph.poses[k]), tight))
    edges = graph.edges
    for of, to, measured, covariance, width in zip(
        edges.of.tolist(),
        edges.to.tolist(),
        edges.measured.tolist(),
        edges.covariance,
        edges.kernel_width.tolist(),
        strict=True,
    ):
        factors.add(gtsam.BetweenFactorPose2(of, to, gtsam.Pose2(*measured), _noise(covariance, width)))
    helpers: dict[int, int] = {}
    aside = gtsam.Pose2(-AUXILIARY_OFFSET_M, 0.0, 0.0)
    sightings = graph.sightings
    for of, landmark, xy, covariance, width in zip(
        sightings.of.tolist(),
        sightings.landmark.tolist(),
        sightings.xy,
        sightings.covariance,
        sightings.kernel_width.tolist(),
        strict=True,
    ):
        seer = of
        if np.hypot(*xy) < MIN_FACTOR_RANGE_M:  # bearing and range are undefined at the pose
            xy = np.add(xy, (AUXILIARY_OFFSET_M, 0.0))
            seer = helpers.get(of, -1)
            if seer < 0:
                seer = helpers[of] = pose_count + landmark_count + len(helpers)
                values.insert(seer, values.atPose2(of).compose(aside))
                factors.add(gtsam.BetweenFactorPose2(of, seer, aside, tight))
        bearing_rad, range_m, of_both = bearing_range(xy, covariance)
        factors.add(
            gtsam.BearingRangeFactor2D(
                seer, pose_count + landmark, gtsam.Rot2(bearing_rad), range_m, _noise(of_both, width)
            )
        )
    return factors, values


def _noise(covariance: Floats, kernel_width: float) -> gtsam.noiseModel.Base:
    gaussian = gtsam.noiseModel.Gaussian.Covariance(covariance)
    if kernel_width == 0.0:
        return gaussian
    return gtsam.noiseModel.Robust.Create(_kernel(kernel_width), gaussian)


@cache
def _kernel(width: float) -> gtsam.noiseModel.mEstimator.Cauchy:
    """One object for all factors of a width."""
    return gtsam.noiseModel.mEstimator.Cauchy.Create(width)


def _optimise(
    factors: gtsam.NonlinearFactorGraph, values: gtsam.Values, config: SolverConfig
) -> gtsam.Values:
    """Iterate step by step: GTSAM keeps the GIL, so other threads run between the steps."""
    optimiser = gtsam.LevenbergMarquardtOptimizer(factors, values, gtsam.LevenbergMarquardtParams())
    for _ in range(config.most_iterations):
        before = optimiser.error()
        optimiser.iterate()
        if before - optimiser.error() <= config.least_gain * before:
            break
    return optimiser.values()


def _read(graph: PoseGraph, values: gtsam.Values) -> tuple[Floats, Floats]:
    count = len(graph.poses)
    found = [values.atPose2(k) for k in range(count)]
    poses = np.array([(pose.x(), pose.y(), pose.theta()) for pose in found])
    landmarks = np.array([values.atPoint2(count + k) for k in range(len(graph.landmarks))])
    return poses, landmarks.reshape(-1, 2)
