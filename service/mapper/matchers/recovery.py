"""Where a scan lies on a map when the prediction was far off: a whole window, by branch and bound."""

import math

import numpy as np

from service.geometry.poses import Floats
from service.geometry.se2 import SE2, wrap_angle
from service.kernels.likelihood_search import LikelihoodLayer
from service.mapper.matchers.window_search import search_bounded, thinned, window_around

BEAMS = 150  # about so many are asked
STEP_RAD = 0.02  # a cell of 10 cm at 5 m
WIDE_RAD, WIDE_STEP_RAD = 2.0, 0.04  # a window wider than the one is searched in steps of the other
GAIN = 0.08  # so much more must lie on the map where a search leads
REST_S = 0.5  # between two searches of the whole window
LEAST = (0.3, 0.2)  # m, rad: windows of a search, half their width
MOST = (8.0, math.pi)  # m, rad: the same at most
FIRST = (2.0, 1.6)  # of a scan that is lost though the prediction is good
SAME_FIND_M, SAME_FIND_RAD = 0.3, 0.06  # two finds of a lost vehicle agree


class Confirmation:
    """A find far from the prediction is a hypothesis, since rooms look alike: the next must say the same."""

    def __init__(self) -> None:
        self._pose_map_odom: SE2 | None = None  # odom of the prediction in that of the map, by the last find

    def forget(self) -> None:
        self._pose_map_odom = None

    def confirms(self, found: SE2, predicted: SE2) -> bool:
        """Whether the find before, carried on by the prediction, says the same; both in one frame."""
        last, self._pose_map_odom = self._pose_map_odom, found @ predicted.inverse()
        if last is None:
            return False
        away = found.inverse() @ last @ predicted
        return math.hypot(away.x_m, away.y_m) < SAME_FIND_M and abs(away.theta_rad) < SAME_FIND_RAD


def search_around(
    xy_base: Floats,
    pose: SE2,
    reach: tuple[float, float],
    layer: LikelihoodLayer,
    step_rad: float = STEP_RAD,
) -> SE2 | None:
    """The pose of the window at which the points lie best on a likelihood map.

    xy_base   (N, 2) m, base frame; N > 0
    pose      middle of the window, in the frame of the map
    reach     (m, rad) half the width of the window
    step_rad  between two headings
    None where nothing of the map lies within reach.
    Source: Hess et al. 2016, Real-Time Loop Closure in 2D LIDAR SLAM, section V.
    """
    window = window_around(np.array([pose.x_m, pose.y_m, pose.theta_rad]), reach, layer, step_rad)
    found = search_bounded(thinned(xy_base, BEAMS), layer, window, layer.offset)
    if not found.score > layer.offset:
        return None
    x_m, y_m, theta_rad = found.pose.tolist()
    return SE2(x_m, y_m, wrap_angle(theta_rad))


def step_of(reach: tuple[float, float]) -> float:
    """How far apart headings may be: a window of so many m and rad must be searched within half a second."""
    return STEP_RAD if reach[1] <= WIDE_RAD else WIDE_STEP_RAD


def reach_of(prior: tuple[float, float]) -> tuple[float, float]:
    """Half the window of a search around a prediction known to so many m and rad: three sigmas of it."""
    reach_m, reach_rad = (
        min(max(3.0 * sigma, least), most) for sigma, least, most in zip(prior, LEAST, MOST, strict=True)
    )
    return reach_m, reach_rad
