"""The systematic error of each laser's ranges, learnt while it maps and taken out of its points."""

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from service.kernels.match import MatchSettings
from service.kernels.range_bias import see_bias, shorten_ranges
from service.mapper.components import Points
from service.mapper.methods.corridor.submaps import Submap

NODE_M, NODES = 0.5, 41
SIGMA_M, SMOOTH_M = 0.01, 0.5  # of the curve before anything is learnt: its size, and how fast it changes
# Offset, slope and bend over 10 m look like another scale of the map, in a corridor like motion: held at 0.
SMOOTH_NODES, SMOOTH_SIGMA_M = 21, 5e-4
SAME_ERRORS = 20.0  # scans in a row that see the same errors of the map
LEARN_EVERY_M = 0.05  # of travel


def _prior() -> npt.NDArray[np.float64]:
    apart = NODE_M / SMOOTH_M * (np.arange(NODES)[:, None] - np.arange(NODES))
    prior = np.linalg.inv(SIGMA_M**2 * (np.exp(-0.5 * apart**2) + 1e-4 * np.eye(NODES)))
    smooth, _ = np.linalg.qr(np.vander(np.linspace(-1.0, 1.0, SMOOTH_NODES), 3))
    prior[:SMOOTH_NODES, :SMOOTH_NODES] += smooth @ smooth.T / SMOOTH_SIGMA_M**2
    return prior


@dataclass(slots=True)
class _Learnt:
    curve_m: npt.NDArray[np.float64] = field(default_factory=lambda: np.zeros(NODES))
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
        settings: MatchSettings,
    ) -> None:
        """Take in a matched scan: deskewed points, their normals (N, 3), and the pose (3,) in the sub-map."""
        learnt = self._learnt[points.scan.sensor]
        learnt.travel_m = 0.0
        information, weighted = np.empty((NODES, NODES)), np.empty(NODES)
        sensor = np.array([points.sensor_base.x_m, points.sensor_base.y_m])
        see_bias(
            points.xy_base, normals, pose, sensor, submap.grid(), settings, NODE_M, information, weighted
        )
        learnt.information += information / SAME_ERRORS
        learnt.curve_m += np.linalg.solve(learnt.information, weighted / SAME_ERRORS)
