"""`make papers`: every experiment, its page in docs/papers/, and a verdict on the terminal."""

import argparse
import importlib
import sys
import time

from service.kernel_warm_up import warm_up
from tests.papers.report import write

PAPERS = {
    "contour_lm": "Contours and learning: profile `contour_lm` (paper 000)",
    "owolm_eskf": "Orthogonal weights and an IMU: profile `owolm_eskf` (paper 002)",
    "imle": "Exhaustive search: profile `imle` (paper 003)",
    "submap_graph": "Sub-maps and a graph: profile `submap_graph` (paper 004)",
    "real_data": "Every profile on recorded data",
}


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.papers", description=__doc__)
    parser.add_argument("--only", action="append", choices=PAPERS, help="this paper alone; may be repeated")
    parser.add_argument("--seeds", type=int, default=5)
    options = parser.parse_args()
    warm_up()
    missed = 0
    for name in options.only or PAPERS:
        began_s = time.monotonic()
        sections = list(importlib.import_module(f"tests.papers.{name}").sections(options.seeds))
        print(write(name, PAPERS[name], sections))
        print(f"{name}: {time.monotonic() - began_s:.0f} s\n", flush=True)
        missed += sum(row.met is False for section in sections for row in section.rows)
    print("every bound is met" if not missed else f"{missed} bounds are missed")
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
