"""Key frames without scans, and those of a laser that sees given walls; two rooms."""

import math
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np

from service.geometry.se2 import SE2
from service.mapper.graph.model.keyframe_list import (
    NO_NORMALS,
    NO_POINTS,
    KeyFrame,
    KeyframeList,
    ThinnedScan,
    thinned,
)
from tests.service.mapper.drives import cast

Walls = list[tuple[float, float, float, float]]
FIRST_RAD, STEP_RAD, BEAMS = -0.75 * math.pi, math.radians(0.5), 541  # blind behind, as most lasers are
NO_SCAN = ThinnedScan(NO_POINTS, NO_NORMALS, (0.0, 0.0))
APART_M = 30.0  # from one room to the other
STOOD = SE2(2.0, 3.1, 0.3)  # in a room, where no key frame was
PILLAR = (3.0, 2.2, 0.4)  # x, y of its corner and its edge, m


def key_frame(stamp_ns: int, pose: SE2, **fields: Any) -> KeyFrame:
    usual = KeyFrame(stamp_ns, pose, np.eye(3), 0, 0.9, False, NO_POINTS, (0.0, 0.0), 0.01)
    return replace(usual, **fields)


def append_blank(keyframes: KeyframeList, frame: KeyFrame) -> None:
    """Without points, with its place in odom as that in the map."""
    keyframes.append(frame, np.array(frame.pose_odom_base), NO_SCAN)


def append(
    keyframes: KeyframeList,
    walls: Walls,
    pose: SE2,
    segment: int,
    noise: np.random.Generator,
    odom: SE2 | None = None,
    sigma_m: float = 0.012,
    **fields: Any,
) -> int:
    """Append a key frame with the walls visible from a pose; its index. odom: its odometry pose, if
    different.
    """
    angle = FIRST_RAD + STEP_RAD * np.arange(BEAMS)
    paths = np.column_stack((np.cos(angle + pose.theta_rad), np.sin(angle + pose.theta_rad)))
    range_m = cast(walls, np.tile([pose.x_m, pose.y_m], (BEAMS, 1)), paths)
    range_m += sigma_m * noise.standard_normal(BEAMS)
    angle, range_m = angle[np.isfinite(range_m)], range_m[np.isfinite(range_m)]
    xy = range_m[:, None] * np.column_stack((np.cos(angle), np.sin(angle)))
    seen = {"xy_base": xy.astype(np.float32), "angle_step_rad": STEP_RAD}
    made = key_frame(keyframes.count, odom or pose, segment=segment, range_sigma_m=sigma_m, **seen, **fields)
    keyframes.append(made, np.array(made.pose_odom_base), thinned(made, 0.04))
    return keyframes.count - 1


def polygon(*corners: tuple[float, float]) -> Walls:
    return [(*a, *b) for a, b in pairwise([*corners, corners[0]])]


def room(at_m: float, with_pillar: bool) -> Walls:
    walls = polygon((0.0, 0.0), (7.0, 0.0), (7.0, 4.0), (5.0, 4.0), (5.0, 5.0), (0.0, 5.0))
    if with_pillar:
        x, y, edge = PILLAR
        walls += polygon((x, y), (x + edge, y), (x + edge, y + edge), (x, y + edge))
    return [(x0 + at_m, y0, x1 + at_m, y1) for x0, y0, x1, y1 in walls]


def rooms(pillar_in_first: bool, pillar_in_second: bool) -> tuple[KeyframeList, np.random.Generator]:
    """A path through each of the two, both in the map."""
    noise, keyframes = np.random.default_rng(5), KeyframeList()
    for at_m, with_pillar in ((0.0, pillar_in_first), (APART_M, pillar_in_second)):
        for x_m in np.arange(1.0, 5.5, 0.3):
            append(keyframes, room(at_m, with_pillar), SE2(at_m + x_m, 1.2, 0.0), 0, noise)
    return keyframes, noise
