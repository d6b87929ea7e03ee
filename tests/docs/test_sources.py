"""The sources that the code names can be found: by author and year, in the list of papers."""

import re

from tests.docs.blocks import ROOT

PAPERS = (ROOT / "docs" / "papers.md").read_text(encoding="utf-8")
KEYS = ("Li et al. 2016", "Qian et al. 2019", "Tang et al. 2014", "Zhang et al. 2016")
FILE_NUMBER = re.compile(r"\bpaper \d{3}\b", re.IGNORECASE)


def test_each_of_the_four_papers_is_listed_with_its_doi():
    rows = [line for line in PAPERS.splitlines() if "doi:10." in line]
    assert tuple(row.split("|")[1].strip() for row in rows) == KEYS


def test_no_source_is_the_number_of_a_file():
    folders = ("config", "docs", "drivers", "service", "simulators", "tests")
    files = [path for folder in folders for path in (ROOT / folder).rglob("*")]
    texts = [path for path in files if path.suffix in {".py", ".yaml", ".md"}]
    assert len(texts) > 500
    found = [path for path in texts if FILE_NUMBER.search(path.read_text(encoding="utf-8"))]
    assert found == []
