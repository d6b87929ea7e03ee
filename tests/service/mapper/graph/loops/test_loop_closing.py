"""What goes to the back end of the graph."""

import numpy as np
import pytest

from service.estimator.motion import Measurement, Motion
from service.geometry.se2 import SE2
from service.mapper.background import Done
from service.mapper.components import MapChange, MappedScan, Match
from service.mapper.graph.loops.loop_back_end import Batch
from service.mapper.graph.loops.loop_closing import LoopClosing
from service.mapper.graph.model.keyframe_list import LoopsConfig
from tests.service.mapper.test_localisation import POINTS

PRIOR = np.diag([0.02, 0.01, 0.01]) ** 2


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
    return MappedScan(k * 10**8, POINTS, match, MapChange(), np.eye(3), PRIOR)


def test_a_key_frame_is_uncertain_by_all_predictions_since_the_one_before() -> None:
    worker = Taken(None)
    graph = LoopClosing(LoopsConfig(keyframe_distance_m=0.3, search_every_m=0.5), None, lambda _: worker)
    for k in range(8):
        graph.add(scan(k, 0.1 * k + 0.01))
    frames = [frame for batch in worker.batches for frame in batch.frames]
    assert [frame.stamp_ns // 10**8 for frame in frames] == [0, 3, 6]
    scans_since = [1, 3, 3]
    for frame, count in zip(frames, scans_since, strict=True):
        assert frame.prediction_variance == pytest.approx((count * 0.02**2, count * 0.01**2))
