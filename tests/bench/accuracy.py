"""The scenarios of tests/accuracy, and their page: a run of some of them replaces only their sections."""

import time
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from pathlib import Path

from service.compile.warm_up import warm_up
from service.mapper.profiles import import_methods
from service.version import VERSION
from tests.accuracy import (
    anchored,
    buildings,
    consistency,
    cost,
    given,
    known_map,
    lasers,
    long_drives,
    loop_rules,
    outages,
    recorded,
    relocalisation,
    rules,
    scenes,
    sensors,
    terrain,
    trials,
)
from tests.papers.report import Section, below_title, seeds_text, write_page

SCENARIOS: dict[str, Callable[[Sequence[int]], Section]] = {
    scenario.__name__: scenario
    for scenario in (
        *(given.given, recorded.recorded, buildings.buildings, buildings.laser_alone, buildings.ring),
        *(known_map.known_map, consistency.consistency, trials.motion, trials.bad_returns),
        *(trials.bare_corridor, buildings.big_mall, terrain.coarse_laser, terrain.terrain),
        *(sensors.slow_mirrors, sensors.wrong_odometry, sensors.frozen_odometry),
        *(sensors.wrong_mounting, sensors.lux_alone, anchored.anchored, trials.parked, lasers.lasers),
        *(outages.outages, outages.outages_alone, scenes.scenes, long_drives.thinned),
        *(long_drives.hour_of_laps, relocalisation.relocalisation, cost.scans, cost.replay_of_fr079),
        *(cost.growing_map, cost.localised, cost.start, rules.rules),
        *(loop_rules.loop_rules,),
    )
}
PAGE = Path(__file__).parents[2] / "build" / "performance.md"
HEAD = """# Performance of the profile `corridor`

`make bench BENCH_ARGS="--only accuracy"` writes this page; `--scenario NAME` runs one scenario, `--seeds 1`
runs one seed. All scenarios use the default parameters. Median and worst are over the seeds; a bound applies
to the median unless its row says otherwise. ATE is the root mean square distance to the truth after the rigid
motion that fits best (Sturm et al. 2012). "As is" is the error without that motion, from the first scan on.
"""


def measure(scenarios: Sequence[str], seeds: Sequence[int]) -> list[tuple[str, float, str]]:
    """Run these, or all; print and keep each table as soon as it is there. Rows: medians, for bench.json."""
    import_methods()
    warm_up()
    rows = []
    for name in scenarios or SCENARIOS:
        began_s = time.monotonic()
        section = SCENARIOS[name](seeds)
        took_s = time.monotonic() - began_s
        print(f"\n{section.title} ({took_s:.0f} s)\n" + "\n".join(below_title(section)), flush=True)
        ran = f"corridor {VERSION}, {datetime.now(UTC).date()}, {seeds_text(seeds)}, {took_s:.0f} s"
        write_page(PAGE, HEAD, {name: (section, ran)}, list(SCENARIOS))
        rows += [(f"{name}: {row.what}", row.median, row.unit) for row in section.rows]
    print(f"written to {PAGE}")
    return rows
