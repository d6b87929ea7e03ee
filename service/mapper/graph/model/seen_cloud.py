"""What key frames of one stretch have seen, as evidence of where it lies."""

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

# Walls far off tell places apart that are alike nearby. There a heading that is off by 0.04 deg moves a
# point by the noise of a wall.
EVIDENCE_RANGE_M = 30.0
SEEN_CELL_M = 0.2  # edge of a cell in which key frames see the same


@dataclass(frozen=True, slots=True, eq=False)
class SeenCloud:
    """Points, and the beams that end in them.

    sensors   (N, 2) m   where the beam of each point begins, in the frame of the cloud
    shares    (N,)       what each point counts: of a wall that several key frames have seen each says the
                         same, so together they count as one of them
    walls     (N,)       the wall or thing that each point lies on, by number
    """

    cloud: PointCloud
    sensors: Floats
    shares: Floats
    walls: npt.NDArray[np.int64]


def seen_cloud(keyframes: KeyframeList, members: Sequence[int], reference: int) -> SeenCloud:
    """Key frames as odometry places them, in the frame of `reference`."""
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
    """(N,) one over how many key frames have seen something in the cell of each point."""
    _, cell = np.unique(np.floor(xy / SEEN_CELL_M).astype(np.int64), axis=0, return_inverse=True)
    cell = cell.reshape(-1)
    several = int(keyframe.max(initial=0)) + 1
    seen = np.unique(cell * several + keyframe)
    shares: Floats = 1.0 / np.bincount(seen // several)[cell]
    return shares
