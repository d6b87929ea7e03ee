"""GNSS fixes in the graph: which are accepted, and the geographic reference of the map by them."""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from service.geometry import poses as se2
from service.geometry.geo_reference import GeoReference
from service.geometry.geodesy import LocalFrame, from_ecef, to_ecef
from service.geometry.poses import Floats
from service.geometry.se2 import SE2
from service.mapper.graph.gnss.fix_consensus import (
    CORRELATED_S,
    MOST_FIXES,
    Consensus,
    FixPath,
    find_consensus,
    fix_edges,
)
from service.mapper.graph.gnss.fix_track import PlacedFix
from service.mapper.graph.model.keyframe_list import KeyframeList
from service.mapper.graph.model.pose_graph import Edges

FAR_M = 1000.0  # a fix farther from the others than the path length plus this is a gross error
FLOOR_M = 0.1  # sigma added to every fix: lever arm, stamps, and a tilted vehicle
MIN_FIXES = 6  # accepted ones for a reference
MAX_YAW_SIGMA_RAD = math.radians(2.0)  # above it the path was too short for a heading of the map
NEW_FIXES_FOR_CONSENSUS = 5, 0.05  # number, and share of all, after which it is computed again
MAX_S = 10.0  # weight limit of a fix after a pause
NEWEST_FIXES = 40  # fixes by which the map's position is checked
SOLVE_AT_M = 0.5  # their mean residual, and one sigma, that makes a solution worth while
FIX_KERNEL_SIGMAS = 3.0  # Cauchy, in sigmas


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
        among, enu, path_length_m = among[is_near], enu[is_near], path_length_m[is_near]
        self.counts["fixes_contradicting"] = int((~is_near).sum())
        if len(among) < MIN_FIXES:
            return False
        consensus = find_consensus(self._way(keyframes, covariance, among, enu, path_length_m))
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
        pose = self._pose_enu_map.inverse()
        return np.array([pose.x_m, pose.y_m, pose.theta_rad])

    def solved(self, pose_map_enu: Floats) -> None:
        """Take the pose of the ENU frame from a solution with the edges."""
        assert self.reference is not None
        assert self._consensus is not None
        old = self.reference
        self._in_map = frozenset(self._among[self._consensus.is_accepted].tolist())
        self.reference = GeoReference(
            old.origin,
            SE2(*pose_map_enu.tolist()).inverse(),
            old.position_sigma_m,
            old.yaw_sigma_rad,
            old.fixes,
        )

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
        base = np.array([(p.x_m, p.y_m, p.theta_rad) for p in (fix.pose_odom_base for fix in fixes)])
        antenna = np.array([fix.antenna_xy_m for fix in fixes])
        return keyframe, se2.points_from(se2.between(keyframes.odom[keyframe], base), antenna)

    def _way(
        self,
        keyframes: KeyframeList,
        covariance: Floats,
        which: npt.NDArray[np.int64],
        enu: Floats,
        path_length_m: Floats,
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
        return FixPath(odom, step, path_length_m, antenna, enu, covariances, repeats)

    def _repeats(self, which: npt.NDArray[np.int64]) -> Floats:
        """(M,) number of fixes, at this rate, that make one independent measurement.

        The first fix after a pause gets a limited weight: no other fix nearby could show it to be reflected.
        """
        stamps_s = np.array([self._fixes[k].stamp_ns for k in which], np.int64) * 1e-9
        since_s = np.minimum(np.diff(stamps_s, prepend=stamps_s[0] - MAX_S), MAX_S)
        repeats: Floats = CORRELATED_S / since_s
        return repeats
