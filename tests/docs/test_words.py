"""The manual speaks in the words of its glossary: names that parts had before are gone."""

import re

import pytest

from tests.docs.blocks import PAGES, ROOT, without_blocks

FORMER = {  # as they were written -> what it is called
    r"errand": "background job",
    r"painter|\bsheet\b": "renderer, rendered map",
    r"rehears\w*": "warm-up",
    r"permanence|what moves|looked through": "dynamic-object filter, static score, ray-cast removal",
    r"usual share|share of hits": "inlier ratio",
    r"la(?:id|y|ys|ying) aside": "disabled, accepted, rejected",
    r"redrawing": "sub-map re-alignment",
    r"voices|command ?desk|map ?keeper|farewell": (
        "protocol identification, command dispatcher, map saver, shutdown request"
    ),
    r"(?:scans?|points?|maps?) laid\b|lays? each|laid (?:where|on)": "at the pose, aligned with",
    r"what \w+ is weighed|weighed by": "weight, weighted by",
    r"never fades|forgets (?:people|them)": "is not decreased, removes",
    r"the walls say|the wheels say": "scan matching, odometry",
}


@pytest.mark.parametrize("page", PAGES, ids=[str(page.relative_to(ROOT)) for page in PAGES])
def test_no_part_is_called_by_a_former_name(page):
    for number, line in enumerate(without_blocks(page), 1):
        plain = re.sub(r"`[^`]*`", "", line)
        for former, today in FORMER.items():
            found = re.search(rf"\b(?:{former})", plain, re.IGNORECASE)
            assert found is None, f"{page}:{number}: {found and found[0]!r}; write: {today}"
