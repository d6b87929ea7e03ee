"""The page's table of states has the figures by which the mapper decides."""

import math
import re
from typing import get_args

import pytest

from service.mapper import judgement
from service.mapper.judgement import JudgementConfig
from service.outputs import ReasonId
from tests.docs.blocks import ROOT

PAGE = (ROOT / "docs" / "mapping.md").read_text(encoding="utf-8")
LIMITS = JudgementConfig()
CONDITIONS = {
    "degraded": (
        f"inlier ratio is below {LIMITS.degraded_ratio:.2f}",
        f"fewer than {judgement.MIN_CONFIRMING} beams returned",
        f"or fewer than {judgement.MIN_RETURNS} for at most {judgement.GAP_S:.1f} s",
        f"worse than {judgement.MAX_SIGMA_M:.2f} m or {math.degrees(judgement.MAX_SIGMA_RAD):.0f} deg",
        f"fixes a direction worse than {LIMITS.degraded_sigma_m:.2f} m",
        f"worse than {judgement.MAX_DRIFT_M:.1f} m or {math.degrees(judgement.MAX_DRIFT_RAD):.0f} deg",
    ),
    "lost": (
        f"fewer than {judgement.MIN_RETURNS} beams returned",
        f"no scan had more for {judgement.GAP_S:.1f} s",
        f"known worse than {judgement.TIGHT_SIGMA_M:.1f} m or {judgement.TIGHT_SIGMA_RAD:.1f} rad",
        f"agreement is below {judgement.MIN_AGREEMENT:.1f}",
        f"inlier ratio is below {LIMITS.lost_ratio:.2f}",
        f"good to {judgement.TIGHT_SIGMA_M:.1f} m and {judgement.TIGHT_SIGMA_RAD:.1f} rad",
        f"ratio is at least {judgement.MIN_KNOWN:.2f}",
        f"worse than {judgement.LOST_SIGMA_M:.2f} m or {judgement.LOST_SIGMA_RAD:.2f} rad",
    ),
}


@pytest.mark.parametrize("state", CONDITIONS)
def test_the_row_of_a_state_has_the_figures_of_the_code(state):
    row = re.search(rf"^\| `{state}` \|.*$", PAGE, re.MULTILINE)
    assert [condition for condition in CONDITIONS[state] if condition not in row[0]] == []


def test_a_far_match_has_the_figures_of_the_code():
    paragraph = re.search(r"^A \*far match\*.*$", PAGE, re.MULTILINE)
    assert f"a chi2 above {judgement.JUMP_CHI2:.1f}" in paragraph[0]
    assert f"more than {judgement.GAP_S:.1f} s" in paragraph[0]
    assert f"an agreement of {judgement.MIN_AGREEMENT_FAR:.2f}" in paragraph[0]


def test_every_reason_id_has_a_row():
    rows = re.findall(r"^\| `(\w+)` \| (?:degraded|lost)", PAGE, re.MULTILINE)
    assert rows == [id for id in get_args(ReasonId) if id]
