"""docs/performance.md: one section a scenario; a run of some of them replaces only theirs.

Sections that no scenario writes stay, behind the others.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

from tests.papers import report
from tests.papers.report import Section

PAGE = Path(__file__).parents[2] / "docs" / "performance.md"
HEAD = """# Performance of the profile `corridor`

Written by `make bench BENCH_ARGS="--only accuracy"`; one scenario by `--scenario NAME`, a quicker look by
`--seeds 1`. One set of parameters for everything. Median and worst are over the seeds; a bound is for the
median unless it says otherwise. ATE: root mean square distance to the truth after the rigid motion that
fits best (Sturm et al. 2012); "as is" means without that motion, from the first scan on.
"""


def write_page(made: Mapping[str, Section], order: Sequence[str], ran: str) -> None:
    """Replace the sections of the scenarios that were made; `ran` says when and on what. Raises OSError."""
    report.write_page(PAGE, HEAD, {name: (section, ran) for name, section in made.items()}, order)
