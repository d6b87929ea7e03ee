"""Every kernel of the landmarks' back end once, in a made-up room: no sub-map waits for a compiler."""

import numpy as np

from service.mapper.graph.made_up_room import STEP_M, seen_from
from service.mapper.methods.submap_graph.counted_submaps import ClosedSubmap, CountedSubmapsConfig
from service.mapper.methods.submap_graph.graph.landmark_back_end import (
    Batch,
    LandmarkBackEnd,
    LandmarkGraphConfig,
    Result,
)
from service.mapper.methods.submap_graph.graph.submap_match import SubmapMatchConfig
from service.mapper.methods.submap_graph.key_scan import KeyScan

SCANS = 4  # a sub-map


def warm_up() -> Result:
    """Three sub-maps along a room: the third is aligned with the first."""
    match = SubmapMatchConfig(
        least_common=10, common_part=0.1, least_inlier_ratio=0.1, landmark_probability=0.6
    )
    back_end = LandmarkBackEnd(LandmarkGraphConfig(match=match, least_on_surfels=0.0), None)
    for number in range(3):
        track = np.zeros((SCANS, 3))
        track[:, 0] = STEP_M * np.arange(number * SCANS, (number + 1) * SCANS)
        scans = []
        for x_m in track[:, 0].tolist():
            xy, step_rad = seen_from(x_m)
            scans.append(KeyScan(round(x_m / STEP_M) * 100_000_000, xy, (0.0, 0.0), step_rad))
        closed = ClosedSubmap(number, 0, tuple(scans), track, CountedSubmapsConfig())
        back_end.work(Batch("submap", closed=closed))
    result: Result = back_end.work(Batch("finish"))
    return result
