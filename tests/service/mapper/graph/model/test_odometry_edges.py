"""Covariance of a step between two key frames: eleven of them straight ahead, one of which is odd."""

from typing import Any

import numpy as np
import pytest

from service.geometry.poses import Floats
from service.geometry.se2 import SE2
from service.mapper.graph.model.keyframe_list import KeyframeList
from service.mapper.graph.model.odometry_edges import (
    LOST_COVARIANCE,
    MIN_EDGE_COVARIANCE,
    NEW_SEGMENT_COVARIANCE,
    STEP_FLOOR,
    odometry_edges,
)
from service.mapper.graph.model.pose_graph import UNKNOWN_COVARIANCE, Edges
from tests.service.mapper.graph.key_frames import append_blank, key_frame

STEP_M, COUNT, ODD = 0.25, 11, 5
MATCHED = np.diag([1e-4, 4e-4, 1e-6])
SOUND = MATCHED + STEP_FLOOR


def edges(ahead_m: float = STEP_M, by_motion: bool = False, usual_m: float = STEP_M, **odd: Any) -> Edges:
    """ahead_m: from the key frame before the odd one to it; usual_m: between the others; `odd`: what else
    differs in that one.
    """
    keyframes = KeyframeList()
    for k in range(COUNT):
        x_m = usual_m * k + (ahead_m - usual_m if k >= ODD else 0.0)
        fields = {"covariance": MATCHED, "motion_covariance": 1e-6 * k * np.eye(3)} | (
            odd if k == ODD else {}
        )
        append_blank(keyframes, key_frame(k, SE2(x_m), **fields))
    return odometry_edges(keyframes, STEP_M, by_motion)


def check(found: Edges, into: Floats, out_of: Floats) -> None:
    """Covariance of the step into the odd key frame and of that out of it; all others are sound."""
    expected = np.tile(SOUND, (COUNT - 1, 1, 1))
    expected[ODD - 1], expected[ODD] = into, out_of
    np.testing.assert_allclose(found.covariance, expected)


def test_without_a_motion_model_lost_steps_have_a_wide_covariance() -> None:
    check(edges(is_lost=True, motion_covariance=None), LOST_COVARIANCE, LOST_COVARIANCE)


@pytest.mark.parametrize("usual_m", [STEP_M, 4.0 * STEP_M], ids=["", "of a thinned log"])
@pytest.mark.parametrize(("beyond_m", "sigma"), [(0.0, 0.0), (3.0, 0.3)])
def test_a_path_without_scans_is_uncertain_by_its_length_beyond_two_steps(
    beyond_m: float, sigma: float, usual_m: float
) -> None:
    """By a tenth of it, m and rad."""
    check(edges(2.0 * usual_m + beyond_m, usual_m=usual_m), SOUND + sigma**2 * np.eye(3), SOUND)


def test_unmatched_steps_have_the_covariance_of_the_motion_model() -> None:
    found = edges(by_motion=True, motion_covariance=None).covariance
    usual = np.diag(np.full(3, 1e-6)) + MIN_EDGE_COVARIANCE
    np.testing.assert_allclose(found[[0, -1]][:, 0, 0], usual[0, 0], rtol=1e-6)
    np.testing.assert_allclose(found[ODD - 1], SOUND)
    np.testing.assert_allclose(found[ODD], SOUND)


def test_a_step_into_a_new_segment_is_unknown_and_back_it_starts_where_the_segment_was_left() -> None:
    found = edges(segment=1)
    np.testing.assert_allclose(found.covariance[ODD - 1], UNKNOWN_COVARIANCE)
    assert (found.of[ODD - 1], found.of[ODD]) == (ODD - 1, ODD - 1)  # out of the segment: from before it
    np.testing.assert_allclose(found.measured[ODD], [2.0 * STEP_M, 0.0, 0.0])
    np.testing.assert_allclose(found.covariance[ODD], SOUND)


@pytest.mark.parametrize("by_motion", [False, True])
@pytest.mark.parametrize(
    ("odd", "is_known"),
    [
        ({"gap_s": 1.5}, True),
        ({"gap_s": 3.0}, False),
        ({"gap_s": 1.5, "is_unmeasured": True}, False),
        ({"gap_s": 1.5, "motion_covariance": None}, False),
    ],
)
def test_a_step_into_a_segment_without_a_scan_gap_has_the_covariance_of_dead_reckoning(
    odd: dict[str, Any], is_known: bool, by_motion: bool
) -> None:
    found = edges(by_motion=by_motion, segment=1, **odd).covariance[ODD - 1]
    expected = NEW_SEGMENT_COVARIANCE if is_known else UNKNOWN_COVARIANCE
    np.testing.assert_allclose(found, expected, atol=2e-5)
