"""Points and matches for the tests of maps."""

import math
from dataclasses import replace
from typing import Any

import numpy as np

from drivers.frames import NO_INTENSITY, LaserScan
from service.estimator.motion import Motion, Prediction
from service.geometry.se2 import SE2
from service.mapper.components import Match, Points
from service.outputs import State

STEP_RAD = math.radians(1.0)


def points_of(xy_base: np.ndarray, stamp_ns: int = 0) -> Points:
    xy_base = np.ascontiguousarray(xy_base, dtype=np.float64)
    count = len(xy_base)
    range_m = np.hypot(xy_base[:, 0], xy_base[:, 1]).astype(np.float32)
    scan = LaserScan("front", stamp_ns, stamp_ns, 0, 0, -math.pi, STEP_RAD, 0.0, 100.0, range_m, NO_INTENSITY)
    return Points(xy_base, xy_base, np.zeros(count), np.arange(count, dtype=np.int32), SE2(), scan)


def square(half_m: float = 2.0, stamp_ns: int = 0) -> Points:
    """A square room around the base."""
    angle = np.arange(-math.pi, math.pi, STEP_RAD)
    direction = np.column_stack([np.cos(angle), np.sin(angle)])
    return points_of(half_m / np.abs(direction).max(axis=1)[:, None] * direction, stamp_ns)


def match_at(pose: SE2, points: Points, state: State = "ok", submap: int | None = None) -> Match:
    return Match(Motion(pose, (0.0, 0.0, 0.0), np.eye(3)), points, 1.0, state, "", submap)


def prediction(pose: SE2, covariance: np.ndarray, **fields: Any) -> Prediction:
    """Of a vehicle that stands, 0.1 s after the scan before."""
    usual = Prediction(pose, (0.0, 0.0, 0.0), covariance, covariance, np.zeros((3, 3)), 0.1, 0.0, True)
    return replace(usual, **fields)
