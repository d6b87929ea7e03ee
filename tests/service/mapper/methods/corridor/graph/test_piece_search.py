"""What is told of a piece that was found once."""

from types import SimpleNamespace

import numpy as np
import pytest

from service.mapper.methods.corridor.graph.keyframe_list import KeyframeList
from service.mapper.methods.corridor.graph.loops_config import LoopsConfig
from service.mapper.methods.corridor.graph.piece_search import CLEARLY_LIKELIER, PieceSearch
from service.mapper.methods.corridor.graph.way_prior import WayPrior

KNOWN = WayPrior(np.zeros(3), np.diag([0.01, 0.01, 0.001]), 100.0)
VAGUE = WayPrior(np.zeros(3), np.diag([9.0, 9.0, 1.0]), 100.0)


@pytest.mark.parametrize(
    ("prior", "evidence", "may_be_there"),
    [
        (KNOWN, 0.0, True),  # new ground: nothing seen speaks for or against
        (KNOWN, -0.9 * CLEARLY_LIKELIER, True),
        (KNOWN, -1.1 * CLEARLY_LIKELIER, False),
        (VAGUE, 0.0, False),
        (None, 0.0, False),
    ],
)
def test_where_dead_reckoning_leads_the_vehicle_may_be_unless_what_is_seen_contradicts(
    prior: WayPrior | None, evidence: float, may_be_there: bool
) -> None:
    search = PieceSearch(LoopsConfig(), KeyframeList())
    search._asked = SimpleNamespace()  # type: ignore[assignment]
    there = SimpleNamespace(weight=SimpleNamespace(evidence=evidence))
    search._known_map = SimpleNamespace(align=lambda seen, pose: there)  # type: ignore[assignment]
    assert search._may_be_at(prior) is may_be_there


@pytest.mark.parametrize("is_disputed", [False, True])
def test_a_find_that_dead_reckoning_disputes_is_kept_for_the_next_one_and_not_told(is_disputed: bool) -> None:
    keyframes = SimpleNamespace(odom=np.zeros((1, 3)), motion_covariance=np.eye(3)[None])
    search = PieceSearch(LoopsConfig(), keyframes)  # type: ignore[arg-type]
    assert search.found_once is None
    loop = SimpleNamespace(to=0, covariance=np.eye(3))
    search._hypothesis = SimpleNamespace(  # type: ignore[assignment]
        pose_map_odom=np.array([1.0, 2.0, 0.5]), loop=loop, piece=3, is_disputed=is_disputed
    )
    told = search.found_once
    assert (told is None) is is_disputed
    if told is not None:
        assert (told.piece, told.pose_map_odom.x_m) == (3, 1.0)
