"""Errors of a trajectory against the truth: another trajectory, or relations between poses.

Relations: Kuemmerle, Steder, Dornhege, Ruhnke, Grisetti, Stachniss, Kleiner, On measuring the accuracy of
SLAM algorithms, Autonomous Robots 27 (2009). ATE and RPE: Sturm et al., A benchmark for the evaluation of
RGB-D SLAM systems, IROS 2012; alignment: Umeyama, PAMI 13 (1991), in the plane and without scale.
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt

from drivers.counted import counted
from service.errors import InputError, UsageError
from service.geometry.poses import Poses, between, compose, inverse, points_from
from service.geometry.se2 import wrap_angle
from service.offline.past.result import read_trajectory
from service.offline.score.trajectory import (
    NS_PER_S,
    Trajectory,
    parse_numbers,
    parse_stamp,
    read_columns,
    read_tum,
)

Pairs = Literal["all", "near"]

NEAR_NS = 120_000_000  # "near": both stamps of a relation this close to a pose of the estimate
MAX_GAP_NS = 1_000_000_000  # a hole in the truth that is not bridged
SAME_NS = 1_000_000  # stamps this close are the same moment, written by two programs
RPE_STEP_M = 1.0
MAX_SHIFT = 4e9  # s or m; from 1970 to a stamp of today and more


@dataclass(frozen=True, slots=True)
class Spread:
    """Statistics of unsigned errors, in metres or degrees. std divides by N - 1."""

    mean: float
    std: float
    max: float
    rms: float


@dataclass(frozen=True, slots=True)
class RelationErrors:
    """One order of the error transform, named."""

    order: str
    translation_m: Spread
    translation_squared_m2: Spread
    rotation_deg: Spread
    rotation_squared_deg2: Spread


@dataclass(frozen=True, slots=True)
class RelationsScore:
    kind: Literal["relations"]
    pairs: Pairs
    pairs_scored: int
    pairs_outside: int  # a stamp lies before or after the trajectory
    pairs_not_near: int  # left out by --pairs near
    shift_s: float
    offset_x_m: float
    errors: tuple[RelationErrors, RelationErrors]

    def __str__(self) -> str:
        lines = [
            f"{counted(self.pairs_scored, 'pair')} scored ({self.pairs}); left out: "
            f"{self.pairs_outside} outside the "
            f"trajectory, {self.pairs_not_near} not near a scan; "
            f"shift {self.shift_s:g} s, offset {self.offset_x_m:g} m"
        ]
        for errors in self.errors:
            lines.append(errors.order)
            lines += [
                f"  {name:<12} {_spread(spread, unit)}"
                for name, spread, unit in (
                    ("translation", errors.translation_m, "m"),
                    ("  squared", errors.translation_squared_m2, "m2"),
                    ("rotation", errors.rotation_deg, "deg"),
                    ("  squared", errors.rotation_squared_deg2, "deg2"),
                )
            ]
        return "\n".join(lines)


@dataclass(frozen=True, slots=True)
class TrajectoryScore:
    kind: Literal["trajectory"]
    poses_scored: int
    poses_left_out: int  # outside the truth, or in a hole of it
    path_m: float  # length of the true path between the first and the last pose scored
    shift_s: float
    offset_x_m: float
    ate_aligned_m: Spread  # after the rigid motion that fits best
    ate_aligned_deg: Spread
    ate_m: Spread  # as they stand: both in the same frame
    ate_deg: Spread
    alignment: tuple[float, float, float]  # x m, y m, theta rad: takes the estimate to the truth
    rpe_step_m: float
    rpe_pairs: int
    rpe_m: Spread | None  # None where the path is shorter than a step
    rpe_deg: Spread | None
    closure_m: float  # first to last pose, against the truth's
    closure_deg: float

    def __str__(self) -> str:
        return "\n".join(
            [
                f"{counted(self.poses_scored, 'pose')} scored over {self.path_m:.1f} m, "
                f"{self.poses_left_out} left out; "
                f"shift {self.shift_s:g} s, offset {self.offset_x_m:g} m",
                f"ATE aligned   {_spread(self.ate_aligned_m, 'm')}",
                f"              {_spread(self.ate_aligned_deg, 'deg')}",
                f"ATE as is     {_spread(self.ate_m, 'm')}",
                f"              {_spread(self.ate_deg, 'deg')}",
                f"RPE over {self.rpe_step_m:g} m  {_spread(self.rpe_m, 'm')}  "
                f"({counted(self.rpe_pairs, 'pair')})",
                f"              {_spread(self.rpe_deg, 'deg')}",
                f"closure       {self.closure_m:.4f} m  {self.closure_deg:.3f} deg",
            ]
        )


ScoreReport = RelationsScore | TrajectoryScore


def score(
    estimate: Path, truth: Path, shift_s: float = 0.0, offset_x_m: float = 0.0, pairs: Pairs = "all"
) -> ScoreReport:
    """Score a TUM file, or the newest version of a result, against a TUM file or a `.relations` file.

    shift_s is added to the estimate's stamps; offset_x_m scores a frame that lies so far ahead of its own.
    Raises InputError with file and line, UsageError for a shift or an offset that is no number of a drive.
    """
    for option, value in (("--shift-s", shift_s), ("--offset-x", offset_x_m)):
        if not abs(value) <= MAX_SHIFT:
            raise UsageError(f"{option} {value}: expected a number between -{MAX_SHIFT:g} and {MAX_SHIFT:g}")
    read = read_trajectory(estimate)
    pose = compose(read.pose, np.array([offset_x_m, 0.0, 0.0])) if offset_x_m else read.pose
    shifted = Trajectory(read.stamp_ns + round(shift_s * NS_PER_S), pose)
    if truth.suffix == ".relations":
        return _score_relations(shifted, truth, shift_s, offset_x_m, pairs)
    if pairs != "all":
        raise InputError(f"{truth}: --pairs {pairs} is for .relations files; a trajectory has no pairs")
    return _score_trajectory(shifted, truth, shift_s, offset_x_m)


def read_relations(path: Path) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], Poses]:
    """Lines `stamp1 stamp2 x y z roll pitch yaw` -> both stamps (N,) ns, pose of 2 seen from 1.

    Raises InputError.
    """
    from_ns, to_ns, relations = [], [], []
    for where, fields in read_columns(path, 8, "stamp1 stamp2 x y z roll pitch yaw"):
        from_ns.append(parse_stamp(fields[0], where))
        to_ns.append(parse_stamp(fields[1], where))
        x, y, _, _, _, yaw = parse_numbers(fields[2:], where)
        relations.append((x, y, yaw))
    if not relations:
        raise InputError(f"{path}: no relation in it")
    return np.array(from_ns, dtype=np.int64), np.array(to_ns, dtype=np.int64), np.array(relations)


def align(estimate: Poses, truth: Poses) -> Poses:
    """(3,) rigid motion T that minimises sum |T estimate - truth|^2 over the positions."""
    mean_e, mean_t = estimate[:, :2].mean(axis=0), truth[:, :2].mean(axis=0)
    e, t = estimate[:, :2] - mean_e, truth[:, :2] - mean_t
    theta = math.atan2((e[:, 0] * t[:, 1] - e[:, 1] * t[:, 0]).sum(), (e * t).sum())
    return np.array([*(mean_t - points_from(np.array([0.0, 0.0, theta]), mean_e)), theta])


def _score_relations(
    estimate: Trajectory, path: Path, shift_s: float, offset_x_m: float, pairs: Pairs
) -> RelationsScore:
    from_ns, to_ns, expected = read_relations(path)
    first, last = estimate.stamp_ns[0], estimate.stamp_ns[-1]
    inside = (np.minimum(from_ns, to_ns) >= first) & (np.maximum(from_ns, to_ns) <= last)
    kept = inside
    if pairs == "near":
        near = (_distance_ns(estimate.stamp_ns, from_ns) <= NEAR_NS) & (
            _distance_ns(estimate.stamp_ns, to_ns) <= NEAR_NS
        )
        kept = inside & near
    if not kept.any():
        raise InputError(
            f"{path}: none of {counted(len(expected), 'pair')} can be scored: "
            f"{np.count_nonzero(~inside)} lie outside "
            f"{_span(estimate)} s; is it another recording, or --shift-s wrong?"
        )
    expected = expected[kept]
    relative = between(estimate.at(from_ns[kept]), estimate.at(to_ns[kept]))
    return RelationsScore(
        kind="relations",
        pairs=pairs,
        pairs_scored=int(np.count_nonzero(kept)),
        pairs_outside=int(np.count_nonzero(~inside)),
        pairs_not_near=int(np.count_nonzero(inside & ~kept)),
        shift_s=shift_s,
        offset_x_m=offset_x_m,
        errors=(
            _relation_errors("kuemmerle: expected^-1 * relative", between(expected, relative)),
            _relation_errors("cartographer: relative * expected^-1", compose(relative, inverse(expected))),
        ),
    )


def _relation_errors(order: str, error: Poses) -> RelationErrors:
    distance, angle = _size(error)
    return RelationErrors(
        order, _spread_of(distance), _spread_of(distance**2), _spread_of(angle), _spread_of(angle**2)
    )


def _score_trajectory(estimate: Trajectory, path: Path, shift_s: float, offset_x_m: float) -> TrajectoryScore:
    truth = read_tum(path)
    known = _known(truth, estimate.stamp_ns)
    if np.count_nonzero(known) < 2:
        raise InputError(
            f"{path}: a truth is known for {np.count_nonzero(known)} of "
            f"{counted(len(known), 'pose')}; it spans "
            f"{_span(truth)} s, the estimate {_span(estimate)} s; is --shift-s wrong?"
        )
    e, t = estimate.pose[known], truth.at(estimate.stamp_ns[known])
    motion = align(e, t)
    path_length_m = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(t[:, :2], axis=0).T))))
    starts, ends = _steps(path_length_m)
    rpe_m, rpe_deg = _size(_relative_error(e, t, starts, ends))
    closure_m, closure_deg = _size(_relative_error(e, t, np.array([0]), np.array([len(e) - 1])))
    aligned_m, aligned_deg = _size(_difference(compose(motion, e), t))
    as_is_m, as_is_deg = _size(_difference(e, t))
    return TrajectoryScore(
        kind="trajectory",
        poses_scored=len(e),
        poses_left_out=int(np.count_nonzero(~known)),
        path_m=float(path_length_m[-1]),
        shift_s=shift_s,
        offset_x_m=offset_x_m,
        ate_aligned_m=_spread_of(aligned_m),
        ate_aligned_deg=_spread_of(aligned_deg),
        ate_m=_spread_of(as_is_m),
        ate_deg=_spread_of(as_is_deg),
        alignment=(float(motion[0]), float(motion[1]), float(motion[2])),
        rpe_step_m=RPE_STEP_M,
        rpe_pairs=len(starts),
        rpe_m=_spread_of(rpe_m) if len(starts) else None,
        rpe_deg=_spread_of(rpe_deg) if len(starts) else None,
        closure_m=float(closure_m[0]),
        closure_deg=float(closure_deg[0]),
    )


def _known(truth: Trajectory, stamp_ns: npt.NDArray[np.int64]) -> npt.NDArray[np.bool_]:
    """Which stamps the truth covers: within it, and not in a hole."""
    inside = (stamp_ns >= truth.stamp_ns[0]) & (stamp_ns <= truth.stamp_ns[-1])
    right = np.clip(np.searchsorted(truth.stamp_ns, stamp_ns), 1, len(truth.stamp_ns) - 1)
    gap = truth.stamp_ns[right] - truth.stamp_ns[right - 1]
    known: npt.NDArray[np.bool_] = inside & (
        (gap <= MAX_GAP_NS) | (_distance_ns(truth.stamp_ns, stamp_ns) <= SAME_NS)
    )
    return known


def _steps(path_length_m: npt.NDArray[np.float64]) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """From each pose to the first that lies RPE_STEP_M further along the true path."""
    ends = np.searchsorted(path_length_m, path_length_m + RPE_STEP_M - 1e-9)
    starts = np.flatnonzero(ends < len(path_length_m))
    return starts, ends[starts]


def _relative_error(e: Poses, t: Poses, starts: npt.NDArray[np.int64], ends: npt.NDArray[np.int64]) -> Poses:
    """(true step)^-1 * (estimated step)."""
    return between(between(t[starts], t[ends]), between(e[starts], e[ends]))


def _difference(a: Poses, b: Poses) -> Poses:
    difference = a - b
    difference[:, 2] = wrap_angle(difference[:, 2])
    return difference


def _size(error: Poses) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Length, m, and angle, deg."""
    return np.hypot(error[:, 0], error[:, 1]), np.abs(np.degrees(error[:, 2]))


def _distance_ns(sorted_ns: npt.NDArray[np.int64], stamp_ns: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """From each stamp to the nearest of sorted_ns."""
    right = np.clip(np.searchsorted(sorted_ns, stamp_ns), 1, len(sorted_ns) - 1)
    distance: npt.NDArray[np.int64] = np.minimum(
        np.abs(stamp_ns - sorted_ns[right - 1]), np.abs(stamp_ns - sorted_ns[right])
    )
    return distance


def _span(trajectory: Trajectory) -> str:
    return f"{trajectory.stamp_ns[0] / NS_PER_S:.3f} .. {trajectory.stamp_ns[-1] / NS_PER_S:.3f}"


def _spread_of(values: npt.NDArray[np.float64]) -> Spread:
    std = float(values.std(ddof=1)) if len(values) > 1 else 0.0
    return Spread(float(values.mean()), std, float(values.max()), float(np.sqrt((values**2).mean())))


def _spread(spread: Spread | None, unit: str) -> str:
    if spread is None:
        return "-"
    return f"{spread.mean:.4f} +- {spread.std:.4f} {unit}, max {spread.max:.4f}, rms {spread.rms:.4f}"
