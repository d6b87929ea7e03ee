"""docs/performance.md: one section a scenario; a run of some of them replaces only theirs.

Sections that no scenario writes stay, behind the others.
"""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from tests.papers.report import Section, below_title

TITLE = "## "
PAGE = Path(__file__).parents[2] / "docs" / "performance.md"
HEAD = """# Performance of the profile `corridor`

Written by `make bench BENCH_ARGS="--only accuracy"`; one scenario by `--scenario NAME`, a quicker look by
`--seeds 1`. One set of parameters for everything. Median and worst are over the seeds; a bound is for the
median unless it says otherwise. ATE: root mean square distance to the truth after the rigid motion that
fits best (Sturm et al. 2012); "as is" means without that motion, from the first scan on.
"""


def write_page(made: Mapping[str, Section], order: Sequence[str], ran: str) -> None:
    """Replace the sections of the scenarios that were made; `ran` says when and on what. Raises OSError."""
    sections = _read(PAGE.read_text(encoding="utf-8")) if PAGE.exists() else {}
    for name, section in made.items():
        lines = [f"{TITLE}{section.title}", "", f"Scenario `{name}`; {ran}. ", "", *below_title(section)]
        sections[name] = "\n".join(line.rstrip() for line in lines).rstrip() + "\n"
    own = [name for name in sections if name.startswith(TITLE)]
    text = "\n".join([HEAD, *(sections[name] for name in [*order, *own] if name in sections)])
    PAGE.write_text(text, encoding="utf-8")


def _read(text: str) -> dict[str, str]:
    """The sections of the page as it is, by scenario; by title where no scenario wrote them."""
    sections = {}
    for part in re.split(rf"^(?={TITLE})", text, flags=re.MULTILINE)[1:]:
        named = re.search(r"^Scenario `(\w+)`", part, flags=re.MULTILINE)
        sections[named[1] if named else part.splitlines()[0]] = part.rstrip() + "\n"
    return sections
