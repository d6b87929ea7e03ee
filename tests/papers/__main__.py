"""`make papers`: every experiment, its page in build/papers/, and a verdict on the terminal."""

import argparse
import importlib
import sys
import time
from collections.abc import Mapping, Sequence

from service.compile.warm_up import warm_up
from service.mapper.profiles import import_methods
from tests.papers.report import FOLDER, Scenario, below_title, seeds_text, write_page

FIRST_SEED = 11  # of the pages
PAPERS = {
    "contour_lm": "Contours and learning: profile `contour_lm` (Li et al. 2016)",
    "owolm_eskf": "Orthogonal weights and an IMU: profile `owolm_eskf` (Qian et al. 2019)",
    "imle": "Exhaustive search: profile `imle` (Tang et al. 2014)",
    "submap_graph": "Sub-maps and a graph: profile `submap_graph` (Zhang et al. 2016)",
    "real_data": "Every profile on recorded data",
}


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.papers", description=__doc__)
    parser.add_argument("--only", action="append", choices=PAPERS, help="this paper alone; may be repeated")
    parser.add_argument(
        "--scenario", action="append", metavar="NAME", help="this section of a page alone; may be repeated"
    )
    parser.add_argument("--seeds", type=int, default=5, metavar="N", help="so many, 5 by default")
    parser.add_argument(
        "--first-seed",
        type=int,
        default=FIRST_SEED,
        metavar="N",
        help=f"{FIRST_SEED} by default: the pages show seeds that nothing was tuned on; tune on those below",
    )
    options = parser.parse_args()
    if options.seeds < 1 or options.first_seed < 1:
        parser.error(
            f"--seeds {options.seeds} --first-seed {options.first_seed}: there must be one seed at least, "
            "and the first is 1 or more"
        )
    scenarios = {
        name: importlib.import_module(f"tests.papers.{name}").SCENARIOS for name in options.only or PAPERS
    }
    known = [scenario for of_paper in scenarios.values() for scenario in of_paper]
    for wanted in options.scenario or []:
        if wanted not in known:
            parser.error(f"--scenario {wanted}: known here are {', '.join(known)}")
    seeds = range(options.first_seed, options.first_seed + options.seeds)
    import_methods()
    warm_up()
    missed = sum(_run(name, of_paper, options.scenario, seeds) for name, of_paper in scenarios.items())
    print("every bound is met" if not missed else f"{missed} bounds are missed")
    return 1 if missed else 0


def _run(name: str, scenarios: Mapping[str, Scenario], wanted: Sequence[str] | None, seeds: range) -> int:
    """Writes one page; what was not asked for stays on it. Returns how many bounds are missed."""
    missed = 0
    for scenario, experiment in scenarios.items():
        if wanted and scenario not in wanted:
            continue
        began_s = time.monotonic()
        section = experiment(seeds)
        head = f"# {PAPERS[name]}\n\nMade by `make papers`; one section by `--scenario`.\n"
        write_page(
            FOLDER / f"{name}.md",
            head,
            {scenario: (section, section.ran_on or seeds_text(seeds))},
            list(scenarios),
        )
        print("\n".join([f"{name} {scenario}: {time.monotonic() - began_s:.0f} s", *below_title(section)]))
        sys.stdout.flush()
        missed += sum(row.met is False for row in section.rows)
    return missed


if __name__ == "__main__":
    sys.exit(main())
