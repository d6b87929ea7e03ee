"""The fault campaign: `python -m tests.chaos [--only ROW]`.

A drive of five fake devices and the service in real time for each row, judged against the truth: map, state,
recovery, losses.
Results are kept in build/chaos.json; build/chaos.md is their table, those of earlier calls too. Exits 1 where
a row is not as expected.
"""

import argparse
import json
import math
import sys
import time
from dataclasses import asdict
from pathlib import Path

from service.compile.cache import ensure_cache_dir

ROOT = Path(__file__).parents[2]
KEPT, TABLE = ROOT / "build" / "chaos.json", ROOT / "build" / "chaos.md"


def main() -> int:
    ensure_cache_dir()
    from tests.chaos.faults import CannotBeHadError
    from tests.chaos.rows import rows

    parser = argparse.ArgumentParser(prog="python -m tests.chaos", description=__doc__)
    parser.add_argument("--only", action="append", default=[], help="a row; a wrong one lists them")
    parser.add_argument("--kills", type=int, default=200, help="of the service (default 200)")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    table = rows(options.seed, options.kills)
    if unknown := set(options.only) - table.keys():
        parser.error(f"no row {', '.join(unknown)}; there are {', '.join(table)}")
    failed = 0
    for name in options.only or table:
        row, began_s = table[name], time.monotonic()
        result: dict[str, object] = {"fault": row.fault, "expected": str(row.expected)}
        try:
            figures, notes = row.run(options.seed, lambda words: print(words, flush=True))
            missed = row.expected.missed_by(figures)
            result |= {"figures": asdict(figures), "notes": notes, "missed": missed}
        except CannotBeHadError as error:
            result["skipped"] = str(error)
        except (AssertionError, OSError) as error:
            result |= {"missed": [f"{type(error).__name__}: {error}"]}
        failed += bool(result.get("missed"))
        _keep(name, result)
        print(f"{name} ({time.monotonic() - began_s:.0f} s): {_measured(result)}", flush=True)
    kept = json.loads(KEPT.read_text())
    _write_table([kept[name] for name in table if name in kept])
    print(f"{failed} not as expected; seed {options.seed}")
    return int(failed > 0)


def _keep(name: str, result: dict[str, object]) -> None:
    kept = json.loads(KEPT.read_text()) if KEPT.exists() else {}
    KEPT.parent.mkdir(exist_ok=True)
    KEPT.write_text(json.dumps(kept | {name: result}, indent=1))


def _measured(result: dict[str, object]) -> str:
    """As text, figures beyond their bounds first."""
    if "skipped" in result:
        return f"not run: {result['skipped']}"
    words = [f"**{missed}**" for missed in result.get("missed", [])]
    if "figures" in result:
        figures = result["figures"]
        words += [
            f"back after {figures['recovery_s']:g} s (`{figures['last']}`)"
            if math.isfinite(figures["recovery_s"])
            else "",
            f"{figures['frames_lost']} frames and {figures['data_lost_s']:g} s lost",
            f"RMSE {figures['rmse_m'] * 1e3:.0f} mm, at the end {figures['end_m'] * 1e3:.0f} mm",
            f"{figures['wrong_ok']} poses wrong and `ok`",
            f"states {', '.join(figures['states'])}",
            *result["notes"],
        ]
    return "; ".join(filter(None, words))


def _write_table(results: list[dict[str, object]]) -> None:
    lines = ["| fault | expected | measured |", "|---|---|---|"]
    lines += [f"| {one['fault']} | {one['expected']} | {_measured(one)} |" for one in results]
    TABLE.write_text("\n".join([*lines, ""]))


if __name__ == "__main__":
    sys.exit(main())
