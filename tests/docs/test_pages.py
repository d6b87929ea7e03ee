"""What holds for every page of the manual."""

import re
from itertools import pairwise

import pytest

from tests.docs.blocks import BLOCKS, PAGES, ROOT, without_blocks

LANGUAGES = {"", "sh", "python", "yaml", "ini"}
LINKING = [*PAGES, ROOT / "CONTRIBUTING.md", ROOT / "tests" / "papers" / "checklist.md"]


def test_every_block_is_in_a_language_that_a_test_runs():
    assert {block.language for block in BLOCKS} <= LANGUAGES


@pytest.mark.parametrize("page", PAGES, ids=[str(page.relative_to(ROOT)) for page in PAGES])
def test_code_stands_in_fences_where_tests_find_it(page):
    """Four spaces make code in Markdown, too, but say nothing of the language."""
    lines = without_blocks(page)
    for before, line in pairwise(lines):
        is_code = not before.strip() and re.match(r" {4}(corridor|make|sudo|pip|python3?|cp|git) ", line)
        assert not is_code, f"{page}: {line}"


@pytest.mark.parametrize("page", LINKING, ids=[str(page.relative_to(ROOT)) for page in LINKING])
def test_links_lead_to_a_file_and_a_heading_that_there_are(page):
    text = "\n".join(without_blocks(page))
    for target, anchor in re.findall(r"\]\(([^)#\s]*)(?:#([^)\s]*))?\)", text):
        if target.startswith(("http://", "https://", "mailto:")):
            continue
        linked = page.parent / target if target else page
        assert linked.exists(), f"{page}: {target}"
        assert not anchor or anchor in anchors_of(linked), f"{page}: {target}#{anchor}"


def anchors_of(page):
    """Of its headings, as GitHub makes them: lower case, punctuation dropped, blanks to hyphens."""
    headings = re.findall(r"^#+ (.*)$", "\n".join(without_blocks(page)), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=[str(page.relative_to(ROOT)) for page in PAGES])
def test_no_table_has_an_empty_first_column(page):
    lines = without_blocks(page)
    for above, rule in pairwise(lines):
        if re.fullmatch(r"\|(\s*:?-+:?\s*\|)+", rule.strip()):
            assert above.split("|")[1].strip(), f"{page}: the first column of {above!r} has no heading"


def test_every_page_is_reached_from_the_readme():
    pages = {page.resolve(): page for page in PAGES}
    reached, ahead = set(), [(ROOT / "README.md").resolve()]
    while ahead:
        page = ahead.pop()
        if page in reached or page not in pages:
            continue
        reached.add(page)
        for target in re.findall(r"\]\(([^)#\s]+\.md)", page.read_text(encoding="utf-8")):
            ahead.append((page.parent / target).resolve())
    assert not pages.keys() - reached


def test_each_of_the_four_papers_is_listed_with_its_doi():
    """By author and year, as the code names them."""
    rows = [line for line in (ROOT / "docs" / "papers.md").read_text().splitlines() if "doi:10." in line]
    keys = ["Li et al. 2016", "Qian et al. 2019", "Tang et al. 2014", "Zhang et al. 2016"]
    assert [row.split("|")[1].strip() for row in rows] == keys
