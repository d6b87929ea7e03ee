"""How well two scans lie on each other at a relation of their poses: what a relation is worth where its
reference is good to 5 to 10 cm only.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial import KDTree

from drivers.frames import LaserScan
from service.geometry.poses import between
from service.offline.score.score import read_relations
from service.offline.score.trajectory import read_tum
from tests.recorded_drive import frames_of

NEIGHBOURS = 5  # of a return, itself among them: its line
WIDEST_M = 0.6  # from a return to the farthest of them
FLATTEST = 0.05  # variance across the line by that along it, at most
REACH_M = 1.0  # from a return to the nearest of the other scan, which it lies beside then
MAX_M = 0.3  # that a return counts: what moved meanwhile lies anywhere
FEWEST = 20  # returns beside a line
NEAR_NS = 200_000_000  # from the stamp of a relation to that of its scan

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class PairFit:
    """Of consecutive relations, at the poses of a trajectory and as the reference has them."""

    ours_m: float  # mean distance of a return from the other scan's line
    reference_m: float
    ours_better: float  # share of relations
    pairs: int


def pair_fit(recording: Path, trajectory: Path, relations: Path, shift_s: float) -> PairFit:
    """Of those relations whose two stamps are those of scans that see something in common."""
    scans = {frame.stamp_ns: frame for frame in frames_of(recording) if isinstance(frame, LaserScan)}
    stamp_ns = np.array(sorted(scans))
    from_ns, to_ns, expected = read_relations(relations)
    shift_ns = round(shift_s * 1e9)
    found = read_tum(trajectory)
    fits = []
    for a_ns, b_ns, reference in zip(from_ns - shift_ns, to_ns - shift_ns, expected, strict=True):
        a, b = (int(stamp_ns[np.abs(stamp_ns - ns).argmin()]) for ns in (a_ns, b_ns))
        if max(abs(a - a_ns), abs(b - b_ns)) > NEAR_NS or a == b:
            continue
        poses = found.at(np.array([a, b]))
        ours = between(poses[0], poses[1])
        here, there = points_of(scans[a]), points_of(scans[b])
        pair = mean_distance_m(here, there, ours), mean_distance_m(here, there, reference)
        if np.isfinite(pair).all():
            fits.append(pair)
    both = np.array(fits)
    return PairFit(*both.mean(axis=0).tolist(), float((both[:, 0] < both[:, 1]).mean()), len(both))


def points_of(scan: LaserScan) -> FloatArray:
    """(N, 2) m in the frame of the laser."""
    range_m = scan.range_m.astype(np.float64)
    angle = scan.first_angle_rad + np.arange(len(range_m)) * scan.angle_step_rad
    is_return = np.isfinite(range_m) & (range_m > scan.range_min_m) & (range_m < scan.range_max_m)
    return np.column_stack([range_m * np.cos(angle), range_m * np.sin(angle)])[is_return]


def mean_distance_m(here: FloatArray, there: FloatArray, pose_here_there: FloatArray) -> float:
    """Mean distance of the returns of one scan from the lines of the other; nan where they share none.

    here, there       (N, 2) and (M, 2) m, each in the frame of its laser
    pose_here_there   (3,) x m, y m, theta rad
    """
    tree = KDTree(here)
    away_m, nearest = tree.query(here, NEIGHBOURS)
    variance, axes = np.linalg.eigh(_covariances(here[nearest]))
    is_line = (variance[:, 0] < FLATTEST * variance[:, 1]) & (away_m.max(axis=1) < WIDEST_M)
    x_m, y_m, theta = pose_here_there
    c, s = np.cos(theta), np.sin(theta)
    moved = there @ np.array([[c, s], [-s, c]]) + (x_m, y_m)
    gap_m, beside = tree.query(moved)
    used = is_line[beside] & (gap_m < REACH_M)
    if used.sum() < FEWEST:
        return float("nan")
    across_m = np.abs(np.sum((moved - here[beside]) * axes[beside, :, 0], axis=1))
    return float(np.minimum(across_m[used], MAX_M).mean())


def _covariances(groups: FloatArray) -> FloatArray:
    centred = groups - groups.mean(axis=1, keepdims=True)
    return np.einsum("nki,nkj->nij", centred, centred) / groups.shape[1]
