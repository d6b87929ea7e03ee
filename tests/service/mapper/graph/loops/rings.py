"""Key frames of a drive round a ring of corridors, with odometry that turns a little too far."""

import math
import pickle
from functools import cache

import numpy as np

from service.geometry import poses as se2
from service.geometry.poses import Floats
from service.geometry.se2 import SE2
from service.mapper.graph.loops.loop_back_end import Batch, LoopBackEnd, Result
from service.mapper.graph.model.keyframe_list import KeyFrame, LoopsConfig
from service.mapper.maps.occupancy import OccupancyConfig, OccupancyTiles
from service.mapper.saved_graph import SavedGraph
from tests.service.mapper.drives import cast

LENGTH_M, WIDTH_M, HALF_M = 14.0, 9.0, 1.0  # of the middle line, and from there to the walls
STEP_M = 0.3
ROUND = round(2.0 * (LENGTH_M + WIDTH_M) / STEP_M)  # key frames
CABINET = np.array([(3.7, -0.9), (4.9, -0.9), (4.9, -0.4), (3.7, -0.4)])
RENDERER = OccupancyTiles(OccupancyConfig(), 0.05).renderer
TURN_ERROR_RADPM = 0.004
FIRST_RAD, STEP_RAD, BEAMS = -2.2, 4.4 / 360, 361


def rectangle(x0: float, y0: float, x1: float, y1: float) -> list[tuple[float, float, float, float]]:
    return [(x0, y0, x1, y0), (x1, y0, x1, y1), (x1, y1, x0, y1), (x0, y1, x0, y0)]


RING = [
    *rectangle(-HALF_M, -HALF_M, LENGTH_M + HALF_M, WIDTH_M + HALF_M),
    *rectangle(HALF_M, HALF_M, LENGTH_M - HALF_M, WIDTH_M - HALF_M),
    *rectangle(4.0, -HALF_M, 4.6, -0.7),  # cabinets, so that no two places look alike
    *rectangle(9.0, 0.7, 9.3, HALF_M),
    *rectangle(LENGTH_M + 0.6, 3.0, LENGTH_M + HALF_M, 3.5),
    *rectangle(10.0, WIDTH_M + 0.7, 11.5, WIDTH_M + HALF_M),
    *rectangle(3.0, WIDTH_M + 0.5, 3.3, WIDTH_M + HALF_M),
    *rectangle(-HALF_M, 5.0, -0.6, 6.2),
]


def round_the_ring(path_length_m: float) -> SE2:
    """Pose of the base at a path length: straight between the corners, turning within a metre of them."""
    corners = [(0.0, 0.0), (LENGTH_M, 0.0), (LENGTH_M, WIDTH_M), (0.0, WIDTH_M)]
    sides = [LENGTH_M, WIDTH_M, LENGTH_M, WIDTH_M]
    turns, left_m = divmod(path_length_m, sum(sides))
    for k, side_m in enumerate(sides):
        if left_m < side_m:
            ahead = math.pi / 2 * k
            turned = math.pi / 2 * max(0.0, left_m - side_m + 1.0)
            x, y = corners[k]
            return SE2(
                x + left_m * math.cos(ahead),
                y + left_m * math.sin(ahead),
                math.remainder(ahead + turned, 2.0 * math.pi),
            )
        left_m -= side_m
    raise AssertionError(turns)


def key_frames(
    rounds: float, seed: int = 0, turn_error_radpm: float = TURN_ERROR_RADPM
) -> tuple[list[KeyFrame], list[SE2]]:
    """And the truth, seen from the first."""
    noise = np.random.default_rng(seed)
    angle = FIRST_RAD + STEP_RAD * np.arange(BEAMS)
    truth, frames = [], []
    accepted = SE2()
    for k in range(int(rounds * 2.0 * (LENGTH_M + WIDTH_M) / STEP_M)):
        pose = round_the_ring(k * STEP_M)
        truth.append(pose)
        if k:
            step = truth[-2].inverse() @ pose
            accepted = accepted @ SE2(step.x_m, step.y_m, step.theta_rad + turn_error_radpm * STEP_M)
        origins = np.tile([pose.x_m, pose.y_m], (BEAMS, 1))
        paths = np.column_stack((np.cos(angle + pose.theta_rad), np.sin(angle + pose.theta_rad)))
        range_m = cast(RING, origins, paths) + 0.005 * noise.standard_normal(BEAMS)
        xy = np.column_stack((range_m * np.cos(angle), range_m * np.sin(angle))).astype(np.float32)
        covariance = np.diag([1e-4, 1e-4, 1e-5])
        frames.append(KeyFrame(k * 10**8, accepted, covariance, 0, 0.9, False, xy, (0.0, 0.0), STEP_RAD))
    return frames, truth


@cache
def ring() -> tuple[list[KeyFrame], list[SE2]]:
    """1.4 rounds, made once for all who look at them."""
    return key_frames(1.4)


@cache
def fed_ring(is_open: bool = False) -> tuple[bytes, list[Result]]:
    """A back end with all of the ring, pickled for each to load a copy, and its results. is_open: no loop is
    accepted, so that the second round lies beside the first.
    """
    frames, _ = ring()
    back_end = LoopBackEnd(LoopsConfig(consensus_span_m=1000.0) if is_open else LoopsConfig(), RENDERER)
    results = [back_end.work(Batch(frames[k : k + 7])) for k in range(0, len(frames), 7)]
    return pickle.dumps(back_end), results


def saved_of(rounds: float) -> SavedGraph:
    frames, _ = key_frames(rounds)
    back_end = LoopBackEnd(LoopsConfig(), None)
    for k in range(0, len(frames), 7):
        back_end.work(Batch(frames[k : k + 7]))
    saved = back_end.work(Batch([], is_last=True)).saved
    assert isinstance(saved, SavedGraph)
    return saved


def seam_m(poses: Floats, truth: list[SE2]) -> Floats:
    """Offset of the second round from the first, by the poses (N, 3) of all key frames."""
    first = np.arange(20, len(truth) - ROUND - 5, 5)
    true = np.array(truth)
    here, there = (se2.between(of[first], of[first + ROUND]) for of in (poses, true))
    return np.hypot(*(here - there)[:, :2].T)
