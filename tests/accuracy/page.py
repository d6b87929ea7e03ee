"""build/performance.md: one section a scenario; a run of some of them replaces only theirs.

Sections that no scenario writes stay, behind the others.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

from tests.papers import report
from tests.papers.report import Section

PAGE = Path(__file__).parents[2] / "build" / "performance.md"
HEAD = """# Performance of the profile `corridor`

`make bench BENCH_ARGS="--only accuracy"` writes this page; `--scenario NAME` runs one scenario, `--seeds 1`
runs one seed. All scenarios use the default parameters. Median and worst are over the seeds; a bound applies
to the median unless its row says otherwise. ATE is the root mean square distance to the truth after the rigid
motion that fits best (Sturm et al. 2012). "As is" is the error without that motion, from the first scan on.
"""


def write_page(made: Mapping[str, Section], order: Sequence[str], ran: str) -> None:
    """Replace the sections of the scenarios that were made; `ran` says when and on what. Raises OSError."""
    report.write_page(PAGE, HEAD, {name: (section, ran) for name, section in made.items()}, order)
