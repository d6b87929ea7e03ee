"""Every kernel of the loop closing once, in a made-up room, so that no loop waits for a compiler."""

import numpy as np

from service.geometry.se2 import SE2
from service.mapper.graph import made_up_room
from service.mapper.methods.corridor.graph.keyframe_list import KeyFrame
from service.mapper.methods.corridor.graph.loop_back_end import LoopBackEnd
from service.mapper.methods.corridor.graph.loop_batches import Batch, Result
from service.mapper.methods.corridor.graph.loops_config import LoopsConfig
from service.mapper.saved_graph import SavedGraph


def warm_up() -> Result:
    """There and back through a room: the way back closes loops with the way there. Then found in its map."""
    config = LoopsConfig(apart_m=0.5, place_m=1.0, search_every_m=0.5, consensus_span_m=0.2)
    back_end = LoopBackEnd(config, None)
    there = [made_up_room.STEP_M * k for k in range(12)]
    frames = [_key_frame_from(x_m, k) for k, x_m in enumerate([*there, *there[-2::-1]])]
    for frame in frames:
        back_end.work(Batch([frame]))
    result: Result = back_end.work(Batch([], is_last=True))
    assert isinstance(result.saved, SavedGraph)
    found: Result = LoopBackEnd(config, None, result.saved, is_localizing=True).work(Batch(frames[:1]))
    return found


def _key_frame_from(x_m: float, number: int) -> KeyFrame:
    covariance = np.diag([1e-4, 1e-4, 1e-5])
    xy, step_rad = made_up_room.seen_from(x_m)
    stamp_ns = number * 100_000_000
    return KeyFrame(stamp_ns, SE2(x_m, 0.0, 0.0), covariance, 0, 1.0, False, xy, (0.0, 0.0), step_rad)
