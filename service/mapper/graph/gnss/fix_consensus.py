"""Fixes that agree with the path by odometry, and the pose of the ENU frame by them.

The path between fixes is that of odometry with its covariance, without loops and earlier fixes, so that a
fix accepted before has no influence on its next evaluation. The poses of the key frames and of the ENU frame
are solved together, with weights that go to zero for outliers.

Source: Yang, Antonante, Tzoumas, Carlone, Graduated non-convexity for robust spatial perception, 2020, eq. 12
to 14 (truncated least squares).
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from service.geometry import poses as se2
from service.geometry.chi2 import CHI2_99_OF_2
from service.geometry.poses import Floats
from service.mapper.graph.model.pose_graph import Edges, Ints, PoseGraph, SolverConfig
from service.mapper.graph.model.pose_graph_solver import solve

HEADING_SIGMA_RAD = 100.0  # of a fix: it does not measure the heading
MIN_EDGE_WEIGHT = 1e-6  # in the solver; edges below are omitted
CORRELATED_S = 120.0  # duration of fixes that make one measurement: twice the correlation time
JUMP_M = 1.5  # plus JUMP_SIGMAS: a larger change of error between fixes is a jump (satellites change)
JUMP_SIGMAS = 0.5  # of the larger sigma of both fixes
STRETCH_SIGMAS = 1.5  # limit of the mean error of an interval between two jumps
MOST_FIXES = 0.5  # share: a larger interval is never rejected, and fewer accepted ones are no consensus
ROUNDS = 6
MU_GROWTH = 2.0  # growth of mu per iteration
MAX_MU = 1e4  # then undecided fixes are within 1e-4 of the gate
QUICK = SolverConfig(most_iterations=4, least_gain=1e-3)


@dataclass(frozen=True, slots=True, eq=False)
class FixPath:
    """M fixes along the path.

    odom         (M, 3)      pose_odom_base of the key frame of each
    step         (M, 3, 3)   covariance of the path from the one before, in the axes of each; row 0: unused
    path_length_m  (M,)      up to each
    antenna      (M, 2) m    at the moment of the fix, in the frame of the key frame
    enu          (M, 2) m    east and north of the fix
    covariance   (M, 2, 2)   m^2, east and north, by the receiver
    repeats      (M,)        number of such fixes that make one independent measurement, >= 1
    """

    odom: Floats
    step: Floats
    path_length_m: Floats
    antenna: Floats
    enu: Floats
    covariance: Floats
    repeats: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Consensus:
    """is_accepted (M,); pose_odom_enu (3,), and its covariance (3, 3) in its own axes."""

    is_accepted: npt.NDArray[np.bool_]
    pose_odom_enu: Floats
    covariance: Floats


def find_consensus(path: FixPath) -> Consensus:
    """Accepted fixes and pose of the ENU frame; M >= 2. Deterministic. Raises GraphError if unsolvable."""
    is_accepted, poses = _graduate(path, np.ones(len(path.odom), np.bool_))
    is_candidate = np.ones(len(path.odom), np.bool_)
    for _ in range(ROUNDS):
        is_wrong = _wrong_stretches(path, _errors(path, poses))
        if not (is_wrong & is_accepted).any() or (is_accepted & ~is_wrong).sum() < 2:
            break
        is_candidate &= ~is_wrong
        is_accepted, poses = _graduate(path, is_candidate)
    solved = solve(_graph(path, poses, is_accepted.astype(np.float64)), covariances_of=[len(path.odom)])
    return Consensus(is_accepted, solved.poses[-1], solved.covariances[len(path.odom)])


def fix_edges(
    enu_index: int,
    keyframe: Ints,
    heading_rad: Floats,
    antenna: Floats,
    enu: Floats,
    covariance: Floats,
    kernel_width: float,
) -> Edges:
    """Fixes as edges from the ENU frame to key frames; they do not measure the heading.

    heading_rad   (M,)        of each key frame against east, at the current estimate
    antenna       (M, 2) m    in the frame of the key frame
    enu           (M, 2) m    of the antenna
    covariance    (M, 2, 2)   m^2, east and north
    """
    count = len(keyframe)
    antenna_enu = np.column_stack((enu, heading_rad))
    lever = np.column_stack((antenna, np.zeros(count)))
    measured = se2.compose(antenna_enu, se2.between(lever, np.zeros(3)))
    c, s = np.cos(heading_rad), np.sin(heading_rad)
    turn = np.array([[c, s], [-s, c]]).transpose(2, 0, 1)
    at_antenna = np.zeros((count, 3, 3))
    at_antenna[:, :2, :2] = turn @ covariance @ turn.transpose(0, 2, 1)
    at_antenna[:, 2, 2] = HEADING_SIGMA_RAD**2
    moved = se2.adjoint(lever)
    return Edges(
        np.full(count, enu_index, np.int64),
        keyframe.astype(np.int64),
        measured,
        moved @ at_antenna @ moved.transpose(0, 2, 1),
        np.full(count, kernel_width),
    )


def align(points: Floats, enu: Floats) -> Floats:
    """(3,) pose_odom_enu by least squares, from (M, 2) points of odom and their (M, 2) east and north.

    Source: Umeyama 1991, in the plane, without scale.
    """
    to, of = points - points.mean(axis=0), enu - enu.mean(axis=0)
    theta = np.arctan2((of[:, 0] * to[:, 1] - of[:, 1] * to[:, 0]).sum(), (of * to).sum())
    turned = se2.points_from(np.array([0.0, 0.0, theta]), enu.mean(axis=0))
    return np.array([*(points.mean(axis=0) - turned), theta])


def _graduate(path: FixPath, is_candidate: npt.NDArray[np.bool_]) -> tuple[npt.NDArray[np.bool_], Floats]:
    """Accepted fixes (M,) and poses (M + 1, 3), the ENU frame last, by graduated non-convexity."""
    points = se2.points_from(path.odom, path.antenna)
    start = align(points[is_candidate], path.enu[is_candidate])
    poses = np.vstack((path.odom, start))
    weight = is_candidate.astype(np.float64)
    poses = solve(_graph(path, poses, weight), QUICK).poses
    chi2 = _chi2(path, poses)
    worst = float(chi2[is_candidate].max())
    if worst <= CHI2_99_OF_2:
        return is_candidate, poses
    mu = max(CHI2_99_OF_2 / (2.0 * worst - CHI2_99_OF_2), 1e-4)
    while True:
        weight = is_candidate * _weights(chi2, mu)
        if weight.sum() < 2.0:
            return weight > 0.5, poses
        poses = solve(_graph(path, poses, weight), QUICK).poses
        chi2 = _chi2(path, poses)
        is_decided = bool(((weight == 0.0) | (weight == 1.0)).all())
        if (is_decided and mu > 1.0) or mu > MAX_MU:
            return weight > 0.5, poses
        mu *= MU_GROWTH


def _weights(chi2: Floats, mu: float) -> Floats:
    """Eq. 14 of the source."""
    low, high = mu / (mu + 1.0) * CHI2_99_OF_2, (mu + 1.0) / mu * CHI2_99_OF_2
    between = np.sqrt(CHI2_99_OF_2 * mu * (mu + 1.0) / np.maximum(chi2, 1e-12)) - mu
    return np.where(chi2 <= low, 1.0, np.where(chi2 >= high, 0.0, between))


def _graph(path: FixPath, poses: Floats, weight: Floats) -> PoseGraph:
    count = len(path.odom)
    used = np.flatnonzero(weight > MIN_EDGE_WEIGHT)
    heading = poses[used, 2] - poses[-1, 2]
    covariance = path.covariance[used] * (path.repeats[used] / weight[used])[:, None, None]
    fixes = fix_edges(count, used, heading, path.antenna[used], path.enu[used], covariance, 0.0)
    step = np.arange(1, count)
    measured = se2.between(path.odom[:-1], path.odom[1:])
    keyframes = Edges(step - 1, step, measured, path.step[1:], np.zeros(count - 1))
    return PoseGraph(poses, keyframes.followed_by(fixes))


def _errors(path: FixPath, poses: Floats) -> Floats:
    """(M, 2) m east and north: fix minus position of the antenna."""
    off: Floats = path.enu - se2.points_seen(poses[-1], se2.points_from(poses[:-1], path.antenna))
    return off


def _chi2(path: FixPath, poses: Floats) -> Floats:
    off = _errors(path, poses)
    return np.asarray(np.einsum("ki,ki->k", off, np.linalg.solve(path.covariance, off[..., None])[..., 0]))


def _wrong_stretches(path: FixPath, off_m: Floats) -> npt.NDArray[np.bool_]:
    """(M,) fixes in an interval between two jumps of the error whose mean error is too large.

    Multipath offsets each fix of a minute by no more than noise may; it differs by its sudden begin and end.
    """
    sigma_m = np.sqrt(np.trace(path.covariance, axis1=1, axis2=2) / 2.0)
    change_m = np.hypot(*np.diff(off_m, axis=0).T)
    limit_m = JUMP_M + JUMP_SIGMAS * np.maximum(sigma_m[1:], sigma_m[:-1])
    starts = np.flatnonzero(change_m > limit_m) + 1
    is_wrong = np.zeros(len(off_m), np.bool_)
    for stretch in np.split(np.arange(len(off_m)), starts):
        if len(stretch) > MOST_FIXES * len(off_m):
            continue
        mean_m = float(np.hypot(*off_m[stretch].mean(axis=0)))
        is_wrong[stretch] = mean_m > STRETCH_SIGMAS * float(sigma_m[stretch].mean())
    return is_wrong
