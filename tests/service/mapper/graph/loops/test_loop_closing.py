"""What goes to the back end of the graph."""

import numpy as np

from service.estimator.motion import Measurement, Motion
from service.geometry.se2 import SE2
from service.mapper.background import Done
from service.mapper.components import MapChange, MappedScan, Match
from service.mapper.graph.loops.loop_back_end import Batch
from service.mapper.graph.loops.loop_closing import WAITING_PER_DOUBLING, LoopClosing
from service.mapper.graph.model.keyframe_list import LoopsConfig
from tests.service.mapper.test_localisation import POINTS


class Taken:
    """A worker that keeps the batches it is given."""

    def __init__(self, back_end: object) -> None:
        self.batches: list[Batch] = []

    def submit(self, batch: Batch) -> Done:
        self.batches.append(batch)
        return Done(None)

    def close(self) -> None: ...


def scan(k: int, x_m: float) -> MappedScan:
    motion = Motion(SE2(x_m), (1.0, 0.0, 0.0), np.eye(3))
    match = Match(motion, POINTS, 0.9, measured=Measurement(motion.pose_odom_base, np.eye(3), np.eye(3), 1.0))
    return MappedScan(k * 10**8, POINTS, match, MapChange(), np.eye(3))


def test_a_key_frame_is_sent_each_so_many_metres() -> None:
    worker = Taken(None)
    graph = LoopClosing(LoopsConfig(keyframe_distance_m=0.3, search_every_m=0.5), None, lambda _: worker)
    for k in range(8):
        graph.add(scan(k, 0.1 * k + 0.01))
    frames = [frame for batch in worker.batches for frame in batch.frames]
    assert [frame.stamp_ns // 10**8 for frame in frames] == [0, 3, 6]


def test_key_frames_are_farther_apart_the_more_of_them_wait_for_the_back_end() -> None:
    """Else hours beside programs that take the processor fill the memory."""
    worker = Taken(None)
    graph = LoopClosing(LoopsConfig(keyframe_distance_m=0.3, search_every_m=0.5), None, lambda _: worker)
    for k in range(20_000):
        graph.add(scan(k, 0.05 * k))
    frames = [frame for batch in worker.batches for frame in batch.frames]
    apart_m = np.diff([frame.pose_odom_base.x_m for frame in frames])
    middle_m = [
        float(np.median(apart_m[k * WAITING_PER_DOUBLING : (k + 1) * WAITING_PER_DOUBLING])) for k in range(4)
    ]
    assert np.allclose(middle_m, [0.3, 0.6, 1.2, 2.4], atol=0.051)
    assert len(frames) < 4 * WAITING_PER_DOUBLING  # instead of 3300 of 1 km
