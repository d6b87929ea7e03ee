"""The kernels that a key frame goes through once, in a sub-map of one point, so that they are compiled."""

from typing import get_type_hints

import numpy as np

from drivers.frames import NO_INTENSITY, LaserScan
from service.geometry.se2 import SE2
from service.kernels.match import MatchSettings
from service.mapper.components import Points
from service.mapper.methods.corridor.range_bias import RangeBias
from service.mapper.methods.corridor.submaps import SubmapsConfig, SurfelSubmaps


def warm_up_insert() -> None:
    """A key frame's points asked for the bias of ranges; inserted; weighed and doubted by what stands."""
    xy = np.ones((1, 2))
    scan = LaserScan(
        sensor="laser",
        stamp_ns=0,
        arrived_ns=0,
        beam_interval_ns=10_000,
        scan_period_ns=100_000_000,
        first_angle_rad=0.0,
        angle_step_rad=0.01,
        range_min_m=0.05,
        range_max_m=100.0,
        range_m=np.ones(1, np.float32),
        intensity=NO_INTENSITY,
    )
    bias = RangeBias()
    points = bias.without(Points(xy, xy.copy(), np.zeros(1), np.zeros(1, np.int32), SE2(), scan))
    normals = np.array([[-1.0, 0.0, 1.0]])
    submap = SurfelSubmaps(SubmapsConfig()).new_submap()
    settings = MatchSettings(*(kind(1) for kind in get_type_hints(MatchSettings).values()))
    bias.learn(points, normals, np.zeros(3), submap, 0, settings)  # first: the drive soon needs it
    submap.insert(points, normals, None, SE2(), 0)
    submap.shorten(0, 0.0)
    submap.weighed(points, normals, np.zeros(3))
    submap.contradicting(points, points.xy_base, normals, np.zeros(3))
    submap.static_residuals(points.xy_base, normals, np.zeros(3))
    submap.moved(points.xy_base, np.zeros(3))
    submap.through_static(points, points.xy_base, np.zeros(3))
