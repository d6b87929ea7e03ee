"""Systematic range error of each laser, learnt while mapping and subtracted from its points."""

import math
from collections import defaultdict
from dataclasses import dataclass, field

import numpy as np

from service.geometry.poses import Floats
from service.kernels.match import MatchSettings
from service.kernels.range_bias import bias_information
from service.mapper.checks.stamp_check import SCANS_WITH_SAME_ERRORS
from service.mapper.components import Points
from service.mapper.scan_match.submaps import Submap

NODES = 41  # of the curve of the bias over range: 0 to 20 m
SIGMA_M = 0.01  # prior of the curve
OFFSET_SIGMA_M = 0.02  # prior of the constant part
# A change of the offset is applied to the map above this size and so many sigmas: each time all walls move.
OFFSET_STEP_M, OFFSET_SIGMAS = 0.001, 2.0
# Offset, slope and curvature over the nearer half of the curve are constrained to 0: they are equivalent to a
# scale of the map, and in a corridor to motion. The offset is estimated separately, from the angles at which
# walls are seen.
SMOOTH_SIGMA_M = 5e-4


def _prior() -> Floats:
    """(NODES + 1, NODES + 1) 1/m^2, the offset last."""
    apart = np.arange(NODES)[:, None] - np.arange(NODES)
    prior = np.linalg.inv(SIGMA_M**2 * (np.exp(-0.5 * apart**2) + 1e-4 * np.eye(NODES)))
    half = NODES // 2 + 1
    smooth, _ = np.linalg.qr(np.vander(np.linspace(-1.0, 1.0, half), 3))
    prior[:half, :half] += smooth @ smooth.T / SMOOTH_SIGMA_M**2
    information = np.diag(np.full(NODES + 1, OFFSET_SIGMA_M**-2))
    information[:NODES, :NODES] = prior
    return information


@dataclass(slots=True)
class _Learnt:
    curve_m: Floats = field(default_factory=lambda: np.zeros(NODES))  # with the offset
    offset_left_m: float = 0.0  # learnt, but not yet applied to curve and map
    information: Floats = field(default_factory=_prior)
    travel_m: float = 0.0  # since the last update


class RangeBias:
    """Range bias of every laser by its name."""

    def __init__(self) -> None:
        self._learnt: defaultdict[str, _Learnt] = defaultdict(_Learnt)

    def curve_m(self, sensor: str) -> Floats:
        """(NODES,) bias of ranges 0, NODE_M, 2 NODE_M, ..., m."""
        return self._learnt[sensor].curve_m

    def is_due(self, sensor: str, travel_m: float, step_m: float) -> bool:
        """Whether step_m was travelled since the last update; adds travel_m."""
        learnt = self._learnt[sensor]
        learnt.travel_m += travel_m
        return learnt.travel_m >= step_m

    def learn(
        self,
        points: Points,
        normals: Floats,
        pose: Floats,
        submap: Submap,
        laser: int,
        settings: MatchSettings,
    ) -> float:
        """Update the bias by a matched scan: deskewed points, normals (N, 3), and pose (3,) in the sub-map.

        Returns the change of the offset, m, by which the laser's walls in the map are to be moved; 0 while it
        is small.
        """
        learnt = self._learnt[points.scan.sensor]
        learnt.travel_m = 0.0
        information, weighted = np.empty((NODES + 1, NODES + 1)), np.empty(NODES + 1)
        grid = submap.grid()
        bias_information(
            points.xy_base,
            normals,
            pose,
            points.sensor_xy_m,
            laser,
            grid,
            settings,
            information,
            weighted,
        )
        weighted -= information[:, NODES] * learnt.offset_left_m
        learnt.information += information / SCANS_WITH_SAME_ERRORS
        of_offset = np.zeros(NODES + 1)
        of_offset[NODES] = 1.0
        step_m, column = np.linalg.solve(
            learnt.information, np.column_stack((weighted / SCANS_WITH_SAME_ERRORS, of_offset))
        ).T
        learnt.curve_m += step_m[:NODES]
        learnt.offset_left_m += float(step_m[NODES])
        sigma_m = math.sqrt(column[NODES])
        if abs(learnt.offset_left_m) < max(OFFSET_STEP_M, OFFSET_SIGMAS * sigma_m):
            return 0.0
        taken_m, learnt.offset_left_m = learnt.offset_left_m, 0.0
        learnt.curve_m += taken_m
        return taken_m
