"""The benchmarks: `python -m tests.bench [--only NAME] [--out bench.json]`. Prints a table, writes JSON."""

import argparse
import json
import os
import platform
import sys
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from service.compile.cache import ensure_cache_dir
from service.version import VERSION

Row = tuple[str, float, str]  # quantity, value, unit


def main() -> int:
    ensure_cache_dir()
    from tests.bench import accuracy, cluster, decoding, fleet, live, reading, secured, site, start_up

    benchmarks: dict[str, Callable[[], list[Row]]] = {
        "decoding": decoding.measure,
        "reading": reading.measure,
        "cluster": cluster.measure,
        "fleet": fleet.measure,
        "site": site.measure,
        "site-parts": site.measure_parts,
        "site-sizes": site.measure_sizes,
        "start-up": start_up.measure,
        "secured": secured.measure,
        "live": live.measure,
        "accuracy": lambda: accuracy.measure(
            parsed.scenario, range(parsed.first_seed, parsed.first_seed + parsed.seeds)
        ),
    }
    parser = argparse.ArgumentParser(prog="python -m tests.bench", description=__doc__)
    parser.add_argument("--only", action="append", choices=sorted(benchmarks), default=[])
    parser.add_argument(
        "--scenario", action="append", choices=sorted(accuracy.SCENARIOS), default=[], help="of accuracy; all"
    )
    parser.add_argument("--seeds", type=int, default=5, help="of accuracy")
    parser.add_argument("--first-seed", type=int, default=11, help="of accuracy; 1 to 5 are for tuning")
    parser.add_argument("--out", type=Path, default=Path("bench.json"))
    parsed = parser.parse_args()
    results: dict[str, Any] = {
        "corridor": VERSION,
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "python": platform.python_version(),
        "machine": f"{os.cpu_count()} x {_processor()}",
        "load_average": os.getloadavg()[0],
    }
    print(f"corridor {VERSION}, Python {results['python']}, {results['machine']}")
    if results["load_average"] > 0.5:
        print(
            f"load average {results['load_average']:.1f}: something else runs here, figures are pessimistic"
        )
    for name, measure in benchmarks.items():
        if parsed.only and name not in parsed.only:
            continue
        rows = measure()
        results[name] = {what: value for what, value, _ in rows}
        for what, value, unit in rows:
            print(f"{name:<10} {what:<44} {value:>10.3f} {unit}", flush=True)
    parsed.out.write_text(json.dumps(results, indent=1) + "\n")
    return 0


def _processor() -> str:
    for line in Path("/proc/cpuinfo").read_text().splitlines():
        if line.startswith("model name"):
            return line.partition(":")[2].strip()
    return platform.machine()


if __name__ == "__main__":
    sys.exit(main())
