"""Closed sub-maps on surfels: their scans realigned point to line, and one sub-map aligned with another.

Particles are aligned with cells of 5 cm, which displace a wall by millimetres in one direction: paths of 12 m
became 5 mm too short. Surfels keep the position of a wall within its cell.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from service.geometry import poses as se2
from service.geometry.poses import Floats
from service.geometry.se2 import wrap_angle
from service.mapper.graph.model.point_clouds import Fit, PointCloud, SurfelSet, cloud_with_noise, joined
from service.mapper.papers.submap_graph.counted_submaps import ClosedSubmap
from service.mapper.papers.submap_graph.key_scan import InsertedScan
from service.mapper.walls import walls_of

# Sigma of a particle's step between key scans, m, m, rad: it fixes a scan along walls without information.
STEP_INFORMATION = np.diag([0.05**-2, 0.05**-2, 0.02**-2])
INFLATION = 16.0  # number of beams with a common error


class SubmapRealignment:
    """Realigns sub-map after sub-map; all stay in the frame of the first scan."""

    def __init__(self, least_inlier_ratio: float) -> None:
        self._least_share = least_inlier_ratio
        self._before: dict[int, Floats] = {}  # by stamp: realigned poses of the previous sub-map
        self._last: tuple[Floats, Floats] | None = None  # newest scan: pose by the particle, realigned

    def realign(self, closed: ClosedSubmap) -> ClosedSubmap:
        """The sub-map with a new track: each scan aligned with the surfels of those before it."""
        map_ = SurfelSet()
        track = closed.track.copy()
        for k, scan in enumerate(closed.scans):
            cloud = _cloud(scan)
            if k < closed.carried:
                track[k] = self._before[scan.stamp_ns]
            elif self._last is not None:
                by_particle, aligned = self._last
                track[k] = self._aligned(
                    map_, cloud, se2.compose(aligned, se2.between(by_particle, closed.track[k]))
                )
            map_.insert(cloud.transformed(track[k]))
            self._last = closed.track[k], track[k]
        self._before = {scan.stamp_ns: pose for scan, pose in zip(closed.scans, track, strict=True)}
        return replace(closed, track=track)

    def _aligned(self, map_: SurfelSet, cloud: PointCloud, guess: Floats) -> Floats:
        fit = map_.align(cloud, guess)
        if fit.share < self._least_share:
            return guess
        information = fit.information / INFLATION
        moved = fit.pose - guess
        moved[2] = wrap_angle(moved[2])
        pose: Floats = guess + np.linalg.solve(information + STEP_INFORMATION, information @ moved)
        return pose


def cloud_of(scans: Sequence[InsertedScan], track: Floats) -> PointCloud:
    """Scans with their poses (K, 3) as one cloud, in the frame of the poses."""
    return joined([_cloud(scan).transformed(pose) for scan, pose in zip(scans, track, strict=True)])


def align_cloud(cloud: PointCloud, surfels: SurfelSet, shift: Floats, most_points: int) -> tuple[Fit, Floats]:
    """Align a cloud with surfels from the pose (3,) `shift` of its frame in theirs.

    Returns the fit about the cloud's middle, where rotation and shift are uncorrelated, and the pose of its
    frame.
    """
    middle = np.array([*cloud.xy.mean(axis=0), 0.0])
    every = max(1, len(cloud.xy) // most_points)
    thin = PointCloud(cloud.xy[::every] - middle[:2], cloud.normals[::every], cloud.sigma_m[::every])
    fit = surfels.align(thin, se2.compose(shift, middle))
    return fit, se2.compose(fit.pose, -middle)


def _cloud(scan: InsertedScan) -> PointCloud:
    xy = scan.xy_base.astype(np.float64)
    return cloud_with_noise(xy, walls_of(xy, scan.sensor_xy_m, scan.angle_step_rad, 0.01)[1])
