"""The systematic error of each laser's ranges, learnt while it maps and taken out of its points."""

import math
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from service.kernels.match import MatchSettings
from service.kernels.range_bias import see_bias, shorten_ranges
from service.mapper.checks.stamp_check import SCANS_WITH_SAME_ERRORS
from service.mapper.components import Points
from service.mapper.scan_match.submaps import Submap

NODE_M, NODES = 0.5, 41  # the curve of the bias over range: 0 to 20 m
SIGMA_M, SMOOTH_M = 0.01, 0.5  # of the curve before anything is learnt: its size, and how fast it changes
OFFSET_SIGMA_M = 0.02  # of what all ranges are too long by, before anything is learnt
# What is learnt of it changes the map where it is so much and so many sigmas: each time all walls are moved.
OFFSET_STEP_M, OFFSET_SIGMAS = 0.001, 2.0
# Offset, slope and bend of the curve over 10 m look like another scale of the map, in a corridor like motion:
# held at 0. What the offset does to the walls shows in the angle at which they are seen, and it is apart.
SMOOTH_NODES, SMOOTH_SIGMA_M = 21, 5e-4
LEARN_EVERY_M = 0.05  # of travel


def _prior() -> npt.NDArray[np.float64]:
    """(NODES + 1, NODES + 1) 1/m^2, the offset last."""
    apart = NODE_M / SMOOTH_M * (np.arange(NODES)[:, None] - np.arange(NODES))
    prior = np.linalg.inv(SIGMA_M**2 * (np.exp(-0.5 * apart**2) + 1e-4 * np.eye(NODES)))
    smooth, _ = np.linalg.qr(np.vander(np.linspace(-1.0, 1.0, SMOOTH_NODES), 3))
    prior[:SMOOTH_NODES, :SMOOTH_NODES] += smooth @ smooth.T / SMOOTH_SIGMA_M**2
    whole = np.diag(np.full(NODES + 1, OFFSET_SIGMA_M**-2))
    whole[:NODES, :NODES] = prior
    return whole


@dataclass(slots=True)
class _Learnt:
    curve_m: npt.NDArray[np.float64] = field(default_factory=lambda: np.zeros(NODES))  # with the offset
    offset_left_m: float = 0.0  # learnt, and not yet in the curve and in the map
    information: npt.NDArray[np.float64] = field(default_factory=_prior)
    travel_m: float = 0.0  # since it was learnt from last


class RangeBias:
    """Of every laser by its name."""

    def __init__(self) -> None:
        self._learnt: dict[str, _Learnt] = {}

    def curve_m(self, sensor: str) -> npt.NDArray[np.float64]:
        """(NODES,) by how much ranges of 0, NODE_M, 2 NODE_M, ... are too long, as far as it is known."""
        return self._learnt[sensor].curve_m if sensor in self._learnt else np.zeros(NODES)

    def without(self, points: Points) -> Points:
        """The points without what is known of the bias."""
        learnt = self._learnt.get(points.scan.sensor)
        if learnt is None:  # not setdefault: the prior takes as long as half a scan
            learnt = self._learnt[points.scan.sensor] = _Learnt()
        xy_raw, xy_base = np.empty_like(points.xy_raw), np.empty_like(points.xy_base)
        sensor = np.array([points.sensor_base.x_m, points.sensor_base.y_m])
        shorten_ranges(points.xy_raw, sensor, learnt.curve_m, NODE_M, xy_raw)
        shorten_ranges(points.xy_base, sensor, learnt.curve_m, NODE_M, xy_base)
        return Points(
            xy_base,
            xy_raw,
            points.beam_time_s,
            points.beam,
            points.sensor_base,
            points.scan,
            points.range_sigma_m,
            points.usual_gap,
        )

    def is_due(self, sensor: str, travel_m: float) -> bool:
        """Whether a scan is to be learnt from, so far on from the one before; LEARN_EVERY_M apart."""
        learnt = self._learnt[sensor]
        learnt.travel_m += travel_m
        return learnt.travel_m >= LEARN_EVERY_M

    def learn(
        self,
        points: Points,
        normals: npt.NDArray[np.float64],
        pose: npt.NDArray[np.float64],
        submap: Submap,
        laser: int,
        settings: MatchSettings,
    ) -> float:
        """Take in a matched scan: deskewed points, their normals (N, 3), and the pose (3,) in the sub-map.

        Returns how much more than before all ranges of the laser are too long, m: what its walls in the map
        are to be moved by; 0 for as long as that is little.
        """
        learnt = self._learnt[points.scan.sensor]
        learnt.travel_m = 0.0
        information, weighted = np.empty((NODES + 1, NODES + 1)), np.empty(NODES + 1)
        sensor = np.array([points.sensor_base.x_m, points.sensor_base.y_m])
        grid = submap.grid()
        see_bias(points.xy_base, normals, pose, sensor, laser, grid, settings, NODE_M, information, weighted)
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
