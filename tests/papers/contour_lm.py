"""Li et al. 2016: niches, a person who walks through, a ring with and without deskewing.

The maps of niches and of the person are fed with true poses, so their figures are their own and not those of
the matcher.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache, partial

import numpy as np

from service.geometry.se2 import SE2
from service.mapper.papers.contour_lm.contour_map import ContourMapConfig
from service.mapper.profiles import mapping_config
from simulators.trajectory import Follow, Pause, plan_drive
from simulators.world import Plan, World, make_world
from simulators.worlds import build_world
from tests.papers.contour_maps import at_phase, learn, offset_m, read
from tests.papers.contour_people import crossing
from tests.papers.report import Row, Section, seeds_text
from tests.simulated import Drive, Run, run

NICHES = (1.5, 4.0, 6.5)  # m along each side, 0.9 m wide and 0.25 m deep
RETURN_M = 2.0
BLUR_ALONE = "what keeps a niche open is that a contour ends at 15 cm, not how it is blurred"
HIDDEN = (
    "scan and map are bent alike where the drive is steady, and the first walls, met again, take drift away"
)
# Neighbouring points are joined whatever lies between them, as where an open door is taken for wall.
JOINED = {"longest_step_m": 1.0, "most_ratio": 1000.0}


def niche_corridor() -> World:
    """A corridor 2 m wide with three sunk doors a side, and a corner of 90 deg at its end."""
    plan = Plan()
    plan.sunk_doors((0.0, -1.0), (12.0, -1.0), NICHES, depth=-0.25)
    plan.sunk_doors((0.0, 1.0), (10.0, 1.0), NICHES, depth=0.25)
    plan.line((12.0, -1.0), (12.0, 8.0), (10.0, 8.0), (10.0, 1.0))
    plan.line((0.0, -1.0), (0.0, 1.0))
    return make_world("niches", plan, [], plan_drive(SE2(1.0, 0.0, 0.0), [Follow([(9.0, 0.0)]), Pause(1.0)]))


def config_of(contours: dict[str, float] | None = None, **blur: object) -> ContourMapConfig:
    return ContourMapConfig.model_validate(
        {"levels": 1, "cell_m": 0.025, "contours": contours or {}, "blur": blur}
    )


@cache
def niche_drive(seed: int) -> Drive:
    return at_phase(niche_corridor(), 9.0, seed)


def in_the_mouths(what: Drive, config: ContourMapConfig) -> float:
    """Mean likelihood of cells in the mouths of the niches, more than 5 cm from any surface (A46)."""
    x = np.concatenate([np.arange(at + 0.06, at + 0.84, 0.02) for at in NICHES]) - 1.0
    xy = np.array([(u, side * v) for u in x for v in np.arange(0.97, 1.05, 0.02) for side in (-1.0, 1.0)])
    return float(read(learn(what, config, 5), xy - offset_m(what))[:, 0].mean())


def niches(seeds: Sequence[int]) -> Section:
    """A46 A10."""

    def mouths(config: ContourMapConfig) -> list[float]:
        return [in_the_mouths(niche_drive(seed), config) for seed in seeds]

    def share(config: ContourMapConfig, base: list[float]) -> list[float]:
        return [value / other for value, other in zip(mouths(config), base, strict=True)]

    compared = partial(Row, "A46", unit="of 1", at_most=0.5)
    joined = mouths(config_of(contours=JOINED, traditional=True))
    own = mouths(config_of(traditional=True))
    rows = [
        Row("A46 A10", "traditional map, points joined up to 1 m: likelihood in the mouths", joined, "of 1"),
        Row("A46 A10", "traditional map on the profile's contours: likelihood there", own, "of 1"),
        compared("the profile by the first: contours and blur differ", share(config_of(), joined)),
        compared(
            "the profile's blur on the long contours, by the first: the blur differs",
            share(config_of(contours=JOINED), joined),
            cause=BLUR_ALONE,
        ),
        compared("the profile by the second: the blur differs", share(config_of(), own), cause=BLUR_ALONE),
    ]
    return Section(
        "Niches",
        "A corridor 2 m wide with six niches of 0.25 x 0.9 m, driven past at true poses; every fifth scan is "
        "learned. A traditional map's contours are as likely between points as at them; in the profile "
        "likelihood falls between points (eq. 6). The profile joins neighbouring points up to 15 cm apart "
        "(eq. 5); the traditional map is built twice: with points joined up to 1 m, so that no contour "
        "ends, and with the profile's own contours. Rows without a bound are for comparison.",
        rows,
    )


def mapped(what: Drive, without_motion: bool = False, **settings: object) -> Run:
    config = mapping_config({"profile": "contour_lm", "settings": settings})
    return run(config, what, without_motion=without_motion)


def thinned(what: Drive, every: int) -> Drive:
    return replace(what, frames=what.frames[::every])


def ring(seeds: Sequence[int]) -> Section:
    """A47 A5, on twice as many seeds as asked for: what deskewing changes is small, and differs by seed."""
    seeds = range(seeds[0], seeds[0] + 2 * len(seeds))
    world = build_world("ring")
    rides = [thinned(at_phase(world, world.drive.duration_s + 0.5, seed), 2) for seed in seeds]
    deskewed = [mapped(ride) for ride in rides]
    raw = [mapped(ride, without_motion=True) for ride in rides]
    figures = {
        "closure": [[r.end_error[0] for r in runs] for runs in (deskewed, raw)],
        "error before the last corner": [
            [before_return(r, ride) for r, ride in zip(runs, rides, strict=True)] for runs in (deskewed, raw)
        ],
        "position, RMS": [[r.position_rmse_m for r in runs] for runs in (deskewed, raw)],
    }
    rows = []
    for name, (with_it, without) in figures.items():
        gain = [b - a for a, b in zip(with_it, without, strict=True)]
        ratio = float(np.median(with_it) / np.median(without))
        better = 100.0 * float(np.mean(np.array(gain) > 0.0))
        rows += [
            Row("A47", f"{name}, with deskewing", with_it, "m"),
            Row("A47", f"{name}, without", without, "m"),
            Row("A47", f"{name}: without less with, seed by seed", gain, "m", at_least=0.0, cause=HIDDEN),
            Row("A47", f"{name}: seeds in which deskewing is better", [better], "%", digits=0),
            Row("A47", f"{name}: median with by median without", [ratio], "times", at_most=0.5, cause=HIDDEN),
        ]
    rows.append(Row("A8", "mean time a scan", [float(r.scan_ms.mean()) for r in deskewed], "ms", digits=1))
    return Section(
        "Ring of 100 m",
        "30 x 20 m, 2 m wide, at 1.2 m/s, corners at about 70 deg/s; laser alone, no loop closing, every "
        "second scan of 50 Hz. Without deskewing, all beams of a sweep are assigned to one "
        "moment. After the last corner the "
        "scans are matched to the first walls again, which removes the drift; the error before that corner "
        "includes it.",
        rows,
        ran_on=seeds_text(seeds),
    )


def before_return(what: Run, ride: Drive) -> float:
    """m: error of the position at the last scan till the base is within RETURN_M of the first leg (y = 0)."""
    away = [k for k, output in enumerate(what.outputs) if ride.truth[output.stamp_ns].y_m > RETURN_M]
    return float(np.hypot(*what.errors[away[-1], :2]))


SCENARIOS = {"niches": niches, "person": crossing, "ring": ring}
