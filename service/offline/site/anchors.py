"""Where fixes put each session of a site on the earth, in one graph."""

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from service.geometry import poses as se2
from service.geometry.geo_reference import GeoReference
from service.geometry.poses import Floats
from service.geometry.se2 import SE2
from service.mapper.graph.gnss.anchoring import FIX_KERNEL_SIGMAS, Anchoring
from service.mapper.graph.model.keyframe_list import KeyframeList
from service.mapper.graph.model.pose_graph import Edges


class StoredAnchors(Anchoring):
    """Sessions that their own fixes anchored: each holds one of its key frames against east and north.

    The fixes themselves are not stored; a session counts by where all of them put its map.
    """

    def __init__(self, of_keyframes: Mapping[int, GeoReference], poses: Floats) -> None:
        """of_keyframes   where key frames lie on the earth
        poses          (N, 3) of all key frames in the map, as a first guess
        """
        super().__init__()
        self._of_keyframes = dict(of_keyframes)
        if not self._of_keyframes:
            return
        first, geo = next(iter(self._of_keyframes.items()))
        self._frame = geo.origin
        weight = sum(1.0 / one.position_sigma_m**2 for one in self._of_keyframes.values())
        of_yaw = sum(1.0 / one.yaw_sigma_rad**2 for one in self._of_keyframes.values())
        self.reference = GeoReference(
            geo.origin,
            geo.pose_enu_map @ SE2(*poses[first].tolist()).inverse(),
            math.sqrt(1.0 / weight),
            math.sqrt(1.0 / of_yaw),
            sum(one.fixes for one in self._of_keyframes.values()),
        )

    def edges(self, keyframes: KeyframeList) -> Edges:
        """Edges from pose N, the frame of east and north in the map, to one key frame of each session."""
        to = np.array(list(self._of_keyframes), np.int64)
        anchors = self._of_keyframes.values()
        sigmas = np.array(
            [(one.position_sigma_m, one.position_sigma_m, one.yaw_sigma_rad) for one in anchors]
        )
        return Edges(
            np.full(len(to), keyframes.count, np.int64),
            to,
            np.array([self._in_frame(one) for one in anchors]),
            np.eye(3) * (sigmas**2)[:, None],
            np.full(len(to), FIX_KERNEL_SIGMAS),
        )

    def solved(self, pose_map_enu: Floats) -> None:
        assert self.reference is not None
        self.reference = replace(self.reference, pose_enu_map=SE2(*pose_map_enu.tolist()).inverse())

    def pose_map_of(self, geo: GeoReference) -> Floats:
        """(3,) in the map of what lies there on the earth. Only where there is a reference."""
        pose: Floats = se2.compose(self.pose_map_enu, np.array(self._in_frame(geo)))
        return pose

    def _in_frame(self, geo: GeoReference) -> tuple[float, float, float]:
        """Its pose against east and north of the first one's origin."""
        assert self._frame is not None
        origin, pose = geo.origin, geo.pose_enu_map
        east_m, north_m, _ = self._frame.to_enu(origin.latitude_deg, origin.longitude_deg, origin.height_m)
        return float(east_m) + pose.x_m, float(north_m) + pose.y_m, pose.theta_rad
