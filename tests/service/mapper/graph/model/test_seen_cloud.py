import numpy as np
import pytest

from service.geometry.se2 import SE2
from service.mapper.graph.model.candidate_submap import EVIDENCE_RANGE_M, seen_cloud
from service.mapper.graph.model.keyframe_list import KeyframeList
from service.mapper.graph.relocalise.known_map import KnownMap
from service.mapper.graph.relocalise.place_search import find_places
from tests.service.mapper.graph.key_frames import STOOD, append, room, rooms


def test_standing_still_adds_no_evidence():
    keyframes, noise = rooms(pillar_in_first=True, pillar_in_second=False)
    walls = room(0.0, with_pillar=True)
    own = [append(keyframes, walls, STOOD, 1, noise) for _ in range(4)]
    known_map = KnownMap(keyframes, np.arange(own[0]))
    evidence = []
    for looks in (1, 4):
        seen = seen_cloud(keyframes, own[:looks], own[0])
        evidence.append(find_places(known_map, seen)[0].score.evidence)
    assert evidence[1] == pytest.approx(evidence[0], rel=0.25)


def test_walls_count_up_to_the_evidence_range():
    keyframes, noise = KeyframeList(), np.random.default_rng(1)
    walls = [
        (EVIDENCE_RANGE_M - 1.0, -9.0, EVIDENCE_RANGE_M - 1.0, 0.0),
        (EVIDENCE_RANGE_M + 3.0, 0.0, EVIDENCE_RANGE_M + 3.0, 9.0),
    ]
    own = append(keyframes, walls, SE2(), 0, noise)
    seen = seen_cloud(keyframes, [own], own)
    assert len(seen.cloud.xy)
    assert (np.abs(seen.cloud.xy[:, 0] - (EVIDENCE_RANGE_M - 1.0)) < 0.1).all()
    assert (seen.sensors == 0.0).all()
