"""The scenarios of tests/accuracy, and the page that shows them."""

from collections.abc import Sequence
from pathlib import Path

from service.compile.warm_up import warm_up
from service.mapper.profiles import import_methods
from tests.accuracy import (
    anchored,
    buildings,
    calibration,
    consistency,
    cost,
    given,
    lasers,
    long_drives,
    outages,
    recorded,
    relocalisation,
    scenes,
    sensors,
    terrain,
    trials,
)
from tests.papers.report import Scenario, run_scenarios

PAGE = Path(__file__).parents[2] / "build" / "performance.md"
HEAD = """# Performance of the profile `corridor`

`make bench BENCH_ARGS="--only accuracy"` writes this page; `--scenario NAME` runs one scenario, `--seeds 1`
runs one seed. All scenarios use the default parameters. Median and worst are over the seeds; a bound applies
to the median unless its row says otherwise. ATE is the root mean square distance to the truth after the rigid
motion that fits best (Sturm et al. 2012). "As is" is the error without that motion, from the first scan on.
"""

SCENARIOS: dict[str, Scenario] = {
    "given": given.given,
    "recorded": recorded.recorded,
    "buildings": buildings.buildings,
    "laser_alone": buildings.laser_alone,
    "ring": buildings.ring,
    "consistency": consistency.consistency,
    "motion": trials.motion,
    "bad_returns": trials.bad_returns,
    "bare_corridor": trials.bare_corridor,
    "mall": buildings.big_mall,
    "coarse_laser": terrain.coarse_laser,
    "terrain": terrain.terrain,
    "slow_mirrors": sensors.slow_mirrors,
    "wrong_odometry": sensors.wrong_odometry,
    "wrong_mounting": sensors.wrong_mounting,
    "lux_alone": sensors.lux_alone,
    "anchored": anchored.anchored,
    "parked": trials.parked,
    "lasers": lasers.lasers,
    "outages": outages.outages,
    "outages_alone": outages.outages_alone,
    "scenes": scenes.scenes,
    "thinned": long_drives.thinned,
    "relocalisation": relocalisation.relocalisation,
    "scans": cost.scans,
    "replay": cost.recording,
    "localised": cost.localised,
    "start": cost.start,
    "calibration": calibration.calibration,
}


def measure(scenarios: Sequence[str], seeds: Sequence[int]) -> list[tuple[str, float, str]]:
    """Run these, or all; print and keep each table as soon as it is there. Rows: medians, for bench.json."""
    import_methods()
    warm_up()
    made = run_scenarios(PAGE, HEAD, SCENARIOS, scenarios or list(SCENARIOS), seeds)
    return [(f"{name}: {row.what}", row.median, row.unit) for name, section in made for row in section.rows]
