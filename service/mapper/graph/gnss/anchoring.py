"""GNSS fixes in the graph: which are accepted, and the geographic reference of the map by them.

The path between fixes is that of odometry with its covariance, without loops and earlier fixes, so that a
fix accepted before has no influence on its next evaluation. The poses of the key frames and of the ENU frame
are solved together, with weights that go to zero for outliers.

Source: Yang, Antonante, Tzoumas, Carlone, Graduated non-convexity for robust spatial perception, 2020, eq. 12
to 14 (truncated least squares).
"""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from service.geometry import poses as se2
from service.geometry.chi2 import CHI2_99_OF_2
from service.geometry.geo_reference import GeoReference, LocalFrame, from_ecef, to_ecef
from service.geometry.poses import Floats
from service.geometry.se2 import SE2
from service.mapper.graph.gnss.fix_track import PlacedFix
from service.mapper.graph.model.keyframe_list import KeyframeList
from service.mapper.graph.model.pose_graph import Edges, Ints, PoseGraph, SolverConfig
from service.mapper.graph.model.pose_graph_solver import solve

FAR_M = 1000.0  # a fix farther from the others than the path length plus this is a gross error
FLOOR_M = 0.1  # sigma added to every fix: lever arm, stamps, and a tilted vehicle
MIN_FIXES = 6  # accepted ones for a reference
MAX_YAW_SIGMA_RAD = math.radians(2.0)  # above it the path was too short for a heading of the map
NEW_FIXES_FOR_CONSENSUS = 5, 0.05  # number, and share of all, after which it is computed again
MAX_S = 10.0  # weight limit of a fix after a pause
NEWEST_FIXES = 40  # fixes by which the map's position is checked
SOLVE_AT_M = 0.5  # their mean residual, and one sigma, that makes a solution worth while
FIX_KERNEL_SIGMAS = 3.0  # Cauchy, in sigmas
HEADING_SIGMA_RAD = 100.0  # of a fix: it does not measure the heading
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
    antenna      (M, 2) m    at the moment of the fix, in the frame of the key frame
    enu          (M, 2) m    east and north of the fix
    covariance   (M, 2, 2)   m^2, east and north, by the receiver
    repeats      (M,)        number of such fixes that make one independent measurement, >= 1
    """

    odom: Floats
    step: Floats
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
    used = np.flatnonzero(weight > 0.0)
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


class Anchoring:
    """Collects fixes, and computes which of them agree with the path of the key frames.

    counts       fixes by their outcome
    reference    geographic reference of the map; None: not known
    """

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self.reference: GeoReference | None = None
        self._fixes: list[PlacedFix] = []
        self._frame: LocalFrame | None = None  # fixed once there is a reference
        self._fixes_at_consensus = 0  # number of kept fixes then
        self._consensus: Consensus | None = None
        self._among: npt.NDArray[np.int64] = np.empty(0, np.int64)  # indices of the fixes in the consensus
        self._in_map: frozenset[int] = frozenset()  # fixes in the newest solution

    def add(self, fixes: Sequence[PlacedFix]) -> None:
        """Add fixes by ascending stamps, no two of one position."""
        self._fixes += fixes

    @property
    def keyframes(self) -> npt.NDArray[np.int64]:
        """(K,) key frames that fixes refer to."""
        return np.array([fix.keyframe for fix in self._fixes], np.int64)

    def renumber(self, number: npt.NDArray[np.int64]) -> None:
        """Replace the indices of N key frames by number (N,)."""
        self._fixes = [replace(fix, keyframe=int(number[fix.keyframe])) for fix in self._fixes]

    @property
    def is_due(self) -> bool:
        """Whether enough fixes have arrived since the last consensus."""
        new = len(self._fixes) - self._fixes_at_consensus
        return len(self._fixes) >= MIN_FIXES and new >= max(
            NEW_FIXES_FOR_CONSENSUS[0], NEW_FIXES_FOR_CONSENSUS[1] * self._fixes_at_consensus
        )

    @property
    def has_changes(self) -> bool:
        return len(self._fixes) >= MIN_FIXES and len(self._fixes) > self._fixes_at_consensus

    def find(self, keyframes: KeyframeList, covariance: Floats, is_known: npt.NDArray[np.bool_]) -> bool:
        """Compute which fixes are accepted; whether the graph should be solved again for them.

        covariance   (N - 1, 3, 3) of the steps between the key frames
        is_known     (N,) key frames with a known place in the map
        """
        self._fixes_at_consensus = len(self._fixes)
        among = np.array([k for k, fix in enumerate(self._fixes) if is_known[fix.keyframe]], np.int64)
        if len(among) < MIN_FIXES:
            return False
        frame = self._frame or self._median_frame(among)
        enu = self._enu(frame, among)
        path_length_m = keyframes.path_length_m[[self._fixes[k].keyframe for k in among]]
        is_near = np.hypot(*enu.T) <= path_length_m[-1] + FAR_M
        among, enu = among[is_near], enu[is_near]
        self.counts["fixes_contradicting"] = int((~is_near).sum())
        if len(among) < MIN_FIXES:
            return False
        consensus = find_consensus(self._fix_path(keyframes, covariance, among, enu))
        accepted = int(consensus.is_accepted.sum())
        self.counts["fixes_contradicting"] += len(among) - accepted
        turned = se2.adjoint(consensus.pose_odom_enu)
        of_map = turned @ consensus.covariance @ turned.T  # of pose_enu_odom, in the axes of odom
        yaw_sigma_rad = math.sqrt(of_map[2, 2])
        is_vague = accepted < MOST_FIXES * len(among) or yaw_sigma_rad > MAX_YAW_SIGMA_RAD
        if accepted < MIN_FIXES or (self.reference is None and is_vague):
            return False  # an existing reference stays, with its fixes
        self.counts["fixes_anchoring"] = accepted
        self._among, self._consensus = among, consensus
        pose_map_enu = SE2(*consensus.pose_odom_enu.tolist())
        if self._frame is None:
            first = self._fixes[int(among[np.argmax(consensus.is_accepted)])]
            self._frame = LocalFrame(first.latitude_deg, first.longitude_deg, first.height_m)
            east_m, north_m, _ = frame.to_enu(first.latitude_deg, first.longitude_deg, first.height_m)
            pose_map_enu = pose_map_enu @ SE2(float(east_m), float(north_m))
        is_first = self.reference is None
        sigma_m = math.sqrt((of_map[0, 0] + of_map[1, 1]) / 2.0)
        pose_enu_map = pose_map_enu.inverse() if is_first else self._pose_enu_map
        self.reference = GeoReference(self._frame, pose_enu_map, sigma_m, yaw_sigma_rad, accepted)
        return is_first or self._is_worth_it(keyframes)

    @property
    def _pose_enu_map(self) -> SE2:
        assert self.reference is not None
        return self.reference.pose_enu_map

    def edges(self, keyframes: KeyframeList) -> Edges:
        """Accepted fixes as edges from pose N, the origin of the ENU frame in the map, to key frames."""
        assert self._frame is not None
        assert self._consensus is not None
        used = self._among[self._consensus.is_accepted]
        keyframe, antenna = self._points(keyframes, used)
        return fix_edges(
            keyframes.count,
            keyframe,
            keyframes.map[keyframe, 2] + self._pose_enu_map.theta_rad,
            antenna,
            self._enu(self._frame, used),
            self._covariances(used) * self._repeats(used)[:, None, None],
            FIX_KERNEL_SIGMAS,
        )

    @property
    def pose_map_enu(self) -> Floats:
        """(3,) pose of the ENU frame in the map, by the newest solution."""
        return np.array(self._pose_enu_map.inverse())

    def solved(self, pose_map_enu: Floats) -> None:
        """Take the pose of the ENU frame from a solution with the edges."""
        assert self.reference is not None
        assert self._consensus is not None
        self._in_map = frozenset(self._among[self._consensus.is_accepted].tolist())
        self.reference = replace(self.reference, pose_enu_map=SE2(*pose_map_enu.tolist()).inverse())

    def _is_worth_it(self, keyframes: KeyframeList) -> bool:
        """Whether a fix in the map is no longer accepted, or the newest ones have a common residual."""
        assert self._frame is not None
        assert self._consensus is not None
        used = self._among[self._consensus.is_accepted]
        if not self._in_map <= set(used.tolist()):
            return True
        used = used[-NEWEST_FIXES:]
        keyframe, antenna = self._points(keyframes, used)
        there = se2.points_seen(self.pose_map_enu, se2.points_from(keyframes.map[keyframe], antenna))
        mean_m = float(np.hypot(*(self._enu(self._frame, used) - there).mean(axis=0)))
        variance = np.trace(self._covariances(used), axis1=1, axis2=2) / 2.0
        sigma_m = math.sqrt(float((variance * self._repeats(used)).sum())) / len(used)
        return mean_m > max(SOLVE_AT_M, sigma_m)

    def _median_frame(self, among: npt.NDArray[np.int64]) -> LocalFrame:
        """A frame at the median of the fixes: a single one may be a gross error."""
        fixes = [self._fixes[k] for k in among]
        ecef = np.array([to_ecef(fix.latitude_deg, fix.longitude_deg, fix.height_m) for fix in fixes])
        return LocalFrame(*from_ecef(np.median(ecef, axis=0)))

    def _enu(self, frame: LocalFrame, which: npt.NDArray[np.int64]) -> Floats:
        """(M, 2) m."""
        fixes = [self._fixes[k] for k in which]
        return np.array([frame.to_enu(f.latitude_deg, f.longitude_deg, f.height_m)[:2] for f in fixes])

    def _covariances(self, which: npt.NDArray[np.int64]) -> Floats:
        """(M, 2, 2) m^2."""
        rows = np.array([self._fixes[k].covariance for k in which])
        return rows[:, [[0, 1], [1, 2]]] + FLOOR_M**2 * np.eye(2)

    def _points(
        self, keyframes: KeyframeList, which: npt.NDArray[np.int64]
    ) -> tuple[npt.NDArray[np.int64], Floats]:
        """Key frame (M,) of each fix, and the antenna (M, 2) in its frame."""
        fixes = [self._fixes[k] for k in which]
        keyframe = np.array([fix.keyframe for fix in fixes], np.int64)
        base = np.array([fix.pose_odom_base for fix in fixes])
        antenna = np.array([fix.antenna_xy_m for fix in fixes])
        return keyframe, se2.points_from(se2.between(keyframes.odom[keyframe], base), antenna)

    def _fix_path(
        self, keyframes: KeyframeList, covariance: Floats, which: npt.NDArray[np.int64], enu: Floats
    ) -> FixPath:
        keyframe, antenna = self._points(keyframes, which)
        odom = keyframes.odom[keyframe]
        last = np.searchsorted(keyframe, np.arange(1, keyframes.count))  # fix at the end of each step
        inside = (last > 0) & (last < len(which))
        moved = se2.adjoint(se2.between(odom[last[inside]], keyframes.odom[1:][inside]))
        step = np.zeros((len(which), 3, 3))
        np.add.at(step, last[inside], moved @ covariance[inside] @ moved.transpose(0, 2, 1))
        step += np.diag([FLOOR_M**2, FLOOR_M**2, 1e-6])
        covariances, repeats = self._covariances(which), self._repeats(which)
        return FixPath(odom, step, antenna, enu, covariances, repeats)

    def _repeats(self, which: npt.NDArray[np.int64]) -> Floats:
        """(M,) number of fixes, at this rate, that make one independent measurement.

        The first fix after a pause gets a limited weight: no other fix nearby could show it to be reflected.
        """
        stamps_s = np.array([self._fixes[k].stamp_ns for k in which], np.int64) * 1e-9
        since_s = np.minimum(np.diff(stamps_s, prepend=stamps_s[0] - MAX_S), MAX_S)
        repeats: Floats = CORRELATED_S / since_s
        return repeats
