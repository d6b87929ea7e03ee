"""Places a detached segment near a pose that the operator has set."""

import numpy as np
import numpy.typing as npt

from service.geometry import poses as se2
from service.geometry.poses import Floats
from service.mapper.graph.model.candidate_submap import MIN_LOOP_SCORE, CandidateSubmap, cloud_of
from service.mapper.graph.model.keyframe_list import KeyframeList
from service.mapper.graph.model.loops import Loop, loop_of
from service.mapper.graph.model.point_clouds import PointCloud
from service.mapper.graph.relocalise.known_map import MAX_QUERY, fits

SUBMAP_RADIUS_M, MAX_SUBMAP_KEYFRAMES = 6.0, 40  # key frames around the pose
WINDOW, MAX_ATTEMPTS = (1.5, 0.35), 10  # m, rad around the pose; key frames tried


class OperatorPose:
    """A pose set by the operator, until scans confirm or contradict it.

    refused   (m, m, rad) the newest pose that scans contradict, while its segment lasts; None: none
    """

    def __init__(self, keyframes: KeyframeList) -> None:
        self._keyframes = keyframes
        self._pose: Floats | None = None  # (3,) in the map, of the newest key frame when it was set
        self._pose_map_odom: Floats | None = None
        self._attempts_left = 0
        self.refused: tuple[float, float, float] | None = None
        self._refused_segment = 0

    def set(self, pose_map_base: Floats) -> None:
        """Expect the vehicle at a pose (3,) m, m, rad."""
        self._pose, self._pose_map_odom = pose_map_base, None
        self._attempts_left = MAX_ATTEMPTS
        self.refused = None

    def refuse(self, segment: int) -> None:
        """Give the pose up, if there is one: the segment lies elsewhere, or nowhere near it."""
        if self._pose is not None:
            x_m, y_m, theta_rad = self._pose.tolist()
            self._pose, self._refused_segment, self.refused = None, segment, (x_m, y_m, theta_rad)

    def find(self, segment: int, known: npt.NDArray[np.int64]) -> tuple[Floats, Loop] | None:
        """Pose (3,) of odom in the map, and the loop that proves it, if the segment fits near the pose.

        known   (K,) indices of the key frames with a known place

        The pose is given up after MAX_ATTEMPTS.
        """
        keyframes = self._keyframes
        if segment != self._refused_segment:
            self.refused = None
        own = np.flatnonzero((keyframes.segment == segment) & keyframes.is_usable)[-MAX_QUERY:]
        if self._pose is None or not len(own) or not len(known):
            return None
        if self._pose_map_odom is None:
            newest = keyframes.odom[keyframes.count - 1]
            self._pose_map_odom = se2.compose(self._pose, se2.between(newest, np.zeros(3)))
        reference = int(own[-1])
        at = se2.compose(self._pose_map_odom, keyframes.odom[reference])
        submap = self._around(known, at)
        loop = self._loop_near(submap, at, cloud_of(keyframes, own.tolist(), reference), reference)
        self._attempts_left -= 1
        if loop is None:
            if self._attempts_left == 0:
                self.refuse(segment)
            return None
        self._pose = None
        found = se2.compose(keyframes.map[submap.reference], loop.measured)
        return se2.compose(found, se2.between(keyframes.odom[reference], np.zeros(3))), loop

    def _around(self, known: npt.NDArray[np.int64], pose: Floats) -> CandidateSubmap:
        """Sub-map of key frames of all passes around a pose (3,) of the map."""
        keyframes = self._keyframes
        away_m = np.hypot(*(keyframes.map[known, :2] - pose[:2]).T)
        nearest = known[np.argsort(away_m, kind="stable")[:MAX_SUBMAP_KEYFRAMES]]
        near = nearest[np.sort(away_m)[:MAX_SUBMAP_KEYFRAMES] <= max(SUBMAP_RADIUS_M, float(away_m.min()))]
        return CandidateSubmap(keyframes, np.sort(near).tolist(), int(near[0]), keyframes.map)

    def _loop_near(
        self, submap: CandidateSubmap, at: Floats, cloud: PointCloud, reference: int
    ) -> Loop | None:
        """The loop of the points to a sub-map if they fit within WINDOW of a pose (3,) of the map."""
        guess = se2.between(self._keyframes.map[submap.reference], at)
        pose = submap.search(cloud, guess, *WINDOW, MIN_LOOP_SCORE)
        if pose is None:
            return None
        fit = submap.align(cloud, pose)
        against = submap.against(cloud, fit.pose)
        if not fits(fit.share, against):
            return None
        return loop_of(
            submap.reference, reference, fit.pose, fit.information, fit.share, len(cloud.xy), against
        )
