"""Every kernel of the loop closing once, in a made-up room, so that no loop waits for a compiler."""

import numpy as np

from service.geometry.se2 import SE2
from service.mapper.graph.keyframe_list import KeyFrame
from service.mapper.graph.loop_back_end import LoopBackEnd
from service.mapper.graph.loop_batches import Batch, Result
from service.mapper.graph.loops_config import LoopsConfig

STEP_M = 0.3
BEAMS = 181


def warm_up() -> Result:
    """There and back through a room: the way back closes loops with the way there."""
    config = LoopsConfig(apart_m=0.5, place_m=1.0, search_every_m=0.5, consensus_span_m=0.2)
    back_end = LoopBackEnd(config, None)
    there = [STEP_M * k for k in range(12)]
    frames = [seen_from(x_m, k) for k, x_m in enumerate([*there, *there[-2::-1]])]
    for frame in frames:
        back_end.work(Batch([frame]))
    result: Result = back_end.work(Batch([], is_last=True))
    return result


def seen_from(x_m: float, k: int) -> KeyFrame:
    """A room from -3 to 7 m by -2 to 2 m, from (x, 0)."""
    angle = np.linspace(-2.3, 2.3, BEAMS)
    with np.errstate(divide="ignore"):
        to_side = 2.0 / np.abs(np.sin(angle))
        to_end = np.where(np.cos(angle) > 0.0, 7.0 - x_m, 3.0 + x_m) / np.abs(np.cos(angle))
    range_m = np.minimum(to_side, to_end)
    xy = np.column_stack((range_m * np.cos(angle), range_m * np.sin(angle))).astype(np.float32)
    covariance = np.diag([1e-4, 1e-4, 1e-5])
    step_rad = 4.6 / (BEAMS - 1)
    return KeyFrame(k * 100_000_000, SE2(x_m, 0.0, 0.0), covariance, 0, 1.0, False, xy, (0.0, 0.0), step_rad)
