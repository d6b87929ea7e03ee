"""Points of several key frames, as a query for place recognition."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from service.geometry import poses as se2
from service.geometry.poses import Floats
from service.kernels.wall_groups import group_by_wall
from service.mapper.graph.model.candidate_submap import seen_by
from service.mapper.graph.model.keyframe_list import KeyframeList
from service.mapper.graph.model.point_clouds import PointCloud, joined

# Distant walls distinguish places that are alike nearby. At this range a heading error of 0.04 deg moves a
# point by the noise of a wall.
EVIDENCE_RANGE_M = 30.0
SEEN_CELL_M = 0.2  # points of several key frames in a cell of this size share their weight


@dataclass(frozen=True, slots=True, eq=False)
class SeenCloud:
    """Points, and the beams that end in them.

    sensors   (N, 2) m   origin of each beam, in the frame of the cloud
    shares    (N,)       weight of each point: one over the number of key frames that saw its cell
    walls     (N,)       number of the wall or object that each point lies on
    """

    cloud: PointCloud
    sensors: Floats
    shares: Floats
    walls: npt.NDArray[np.int64]

    @property
    def mass(self) -> float:
        """Sum of the shares."""
        return max(float(self.shares.sum()), 1e-9)


def seen_cloud(keyframes: KeyframeList, members: Sequence[int], reference: int) -> SeenCloud:
    """Query of key frames, placed by odometry, in the frame of `reference`."""
    odom = keyframes.odom
    clouds, sensors, number = [], [], []
    for n, k in enumerate(members):
        step = se2.between(odom[reference], odom[k])
        clouds.append(seen_by(keyframes, k, EVIDENCE_RANGE_M).transformed(step))
        count = len(clouds[-1].xy)
        sensors.append(np.tile(se2.points_from(step, np.array(keyframes.thinned[k].sensor_xy_m)), (count, 1)))
        number.append(np.full(count, n))
    cloud = joined(clouds)
    walls = np.empty(len(cloud.xy), np.int64)
    group_by_wall(cloud.xy, cloud.normals, cloud.sigma_m, walls)
    return SeenCloud(cloud, np.concatenate(sensors), _shares(cloud.xy, np.concatenate(number)), walls)


def _shares(xy: Floats, keyframe: np.ndarray) -> Floats:
    """(N,) one over the number of key frames with a point in the cell of each point."""
    _, cell = np.unique(np.floor(xy / SEEN_CELL_M).astype(np.int64), axis=0, return_inverse=True)
    cell = cell.reshape(-1)
    several = int(keyframe.max(initial=0)) + 1
    seen = np.unique(cell * several + keyframe)
    shares: Floats = 1.0 / np.bincount(seen // several)[cell]
    return shares
