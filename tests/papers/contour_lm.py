"""Li et al. 2016: niches, people who walk through, a ring with and without deskewing, a long corridor.

The maps of niches and people are made at true poses, so their errors are not those of the matcher.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np

from service.geometry.se2 import SE2
from service.kernels.contours import extract_contours
from service.mapper.papers.contour_lm.contour_map import ContourMapConfig
from service.mapper.profiles import mapping_config
from simulators.trajectory import Follow, Limits, Pause, Spin, plan_drive
from simulators.world import Plan, World, make_world
from simulators.worlds import build_world
from tests.papers.contour_maps import BEAMS, at_phase, grid, learn, offset_m, read
from tests.papers.contour_people import crossing, crowd, protection
from tests.papers.contour_pictures import draw_niches, rasterise_scan
from tests.papers.contour_search import starts
from tests.papers.recorded import error_row, scored
from tests.papers.report import Row, Section, seeds_text
from tests.papers.true_poses import true_scans
from tests.simulated import LMS100_50HZ, UTM30LX_40HZ, Drive, Imu, Run, begun_beside, drive, phase_m, run

NICHES = (1.5, 4.0, 6.5)  # m along each side, 0.9 m wide and 0.25 m deep
LONG_SEEDS = 2  # of the corridor of 100 m: each takes a minute
RETURN_M = 2.0
PAIRED_SCANS = 500  # A8
OURS, INERTIAL, PAIRS = "`contour_lm`", "`owolm_eskf` with an IMU", "pairwise ICP"
BIASED = "in a bare corridor its own far points bias it backwards"
TURN_RADPS = 0.5 * math.pi
AT_M = 5.0
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


def config_of(
    cell_m: float = 0.025, contours: dict[str, float] | None = None, **blur: object
) -> ContourMapConfig:
    return ContourMapConfig.model_validate(
        {"levels": 1, "cell_m": cell_m, "contours": contours or {}, "blur": blur}
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
    """A46 A10 A19."""

    def mouths(config: ContourMapConfig) -> list[float]:
        return [in_the_mouths(niche_drive(seed), config) for seed in seeds]

    def share(config: ContourMapConfig, base: list[float]) -> list[float]:
        return [value / other for value, other in zip(mouths(config), base, strict=True)]

    joined = mouths(config_of(contours=JOINED, traditional=True))
    own = mouths(config_of(traditional=True))
    rows = [
        Row("traditional map, points joined up to 1 m: likelihood in the mouths", joined, "of 1", "A46 A10"),
        Row("traditional map on the profile's contours: likelihood there", own, "of 1", "A46 A10"),
        Row(
            "the profile by the first: contours and blur differ",
            share(config_of(), joined),
            "of 1",
            "A46",
            at_most=0.5,
        ),
        Row(
            "the profile's blur on the long contours, by the first: the blur differs",
            share(config_of(contours=JOINED), joined),
            "of 1",
            "A46",
            at_most=0.5,
            cause=BLUR_ALONE,
        ),
        Row(
            "the profile by the second: the blur differs",
            share(config_of(), own),
            "of 1",
            "A46",
            at_most=0.5,
            cause=BLUR_ALONE,
        ),
    ]
    for cell_m in (0.01, 0.025, 0.05):
        base = in_the_mouths(niche_drive(seeds[0]), config_of(cell_m, JOINED, traditional=True))
        for along, across in ((10.0, 1.5), (1.5, 10.0)):
            config = config_of(cell_m, along_cells=along, across_cells=across)
            what = f"cells of {100 * cell_m:g} cm, {along:g} along, {across:g} across: share, seed {seeds[0]}"
            rows.append(Row(what, [in_the_mouths(niche_drive(seeds[0]), config) / base], "of 1", "A19"))
    maps = {
        "traditional": learn(niche_drive(seeds[0]), config_of(contours=JOINED, traditional=True), 5),
        "profile": learn(niche_drive(seeds[0]), config_of(), 5),
    }
    window = (-1.0, 11.5, -1.6, 4.0)
    xy = grid(window, 0.025)
    picture = draw_niches(
        {name: read(made, xy - offset_m(niche_drive(seeds[0])))[:, 0] for name, made in maps.items()},
        xy,
        0.025,
        window,
        seeds[0],
    )
    return Section(
        "Niches",
        "A corridor 2 m wide with six niches of 0.25 x 0.9 m, driven past at true poses; every fifth scan is "
        "learned. A traditional map's contours are as likely between points as at them; in the profile "
        "likelihood falls between points (eq. 6). The profile joins neighbouring points up to 15 cm apart "
        "(eq. 5); the traditional map is built twice: with points joined up to 1 m, so that no contour "
        "ends, and with the profile's own contours. Rows without a bound are for comparison.",
        rows,
        pictures=[picture, one_scan(seeds[0])],
    )


def one_scan(seed: int) -> tuple[str, str]:
    """A16 A21: the first scan of the corridor with niches."""
    what = niche_drive(seed)
    points, _ = next(true_scans(what, BEAMS))
    contours = ContourMapConfig().contours
    contour = np.empty(len(points.xy_base), np.int32)
    extract_contours(points.xy_base, contours.longest_step_m, contours.most_ratio, contour)
    window = (2.2, 5.0, 0.6, 1.6)
    cells = grid(window, 0.025)
    blurs = {"blurred across alone": config_of(traditional=True), "across and along": config_of()}
    maps = {name: read(learn(what, config, len(what.frames)), cells)[:, 0] for name, config in blurs.items()}
    return rasterise_scan(points.xy_base, contour, maps, cells, 0.025, window)


def mapped(what: Drive, without_motion: bool = False, **settings: object) -> Run:
    config = mapping_config({"profile": "contour_lm", "settings": settings})
    return run(config, what, without_motion=without_motion)


def thinned(what: Drive, every: int) -> Drive:
    return replace(what, frames=what.frames[::every])


def ring(seeds: Sequence[int]) -> Section:
    """A47 A5, on twice as many seeds as asked for: the effect of deskewing is small, and differs by seed."""
    seeds = range(seeds[0], seeds[0] + 2 * len(seeds))
    world = build_world("ring")
    rides = [thinned(at_phase(world, world.drive.duration_s + 0.5, seed), 2) for seed in seeds]
    deskewed = [mapped(ride) for ride in rides]
    raw = [mapped(ride, without_motion=True) for ride in rides]
    literal = mapped(rides[0], matcher={"beam_time": "printed"})
    seldom = mapped(rides[0], local_map={"insert_time_s": 0.1})
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
            Row(f"{name}, with deskewing", with_it, "m", "A47"),
            Row(f"{name}, without", without, "m", "A47"),
            Row(f"{name}: without less with, seed by seed", gain, "m", "A47", at_least=0.0, cause=HIDDEN),
            Row(f"{name}: seeds in which deskewing is better", [better], "%", "A47"),
            Row(f"{name}: median with by median without", [ratio], "times", "A47", at_most=0.5, cause=HIDDEN),
        ]
    first = f"seed {seeds[0]}"
    rows += [
        Row(f"printed time between beams: closure, {first}", [literal.end_error[0]], "m", "A5"),
        Row(f"printed time between beams: position, RMS, {first}", [literal.position_rmse_m], "m", "A5"),
        Row(f"a scan learned each 0.1 s: closure, {first}", [seldom.end_error[0]], "m", "A36"),
        Row(f"a scan learned each 0.1 s: position, RMS, {first}", [seldom.position_rmse_m], "m", "A36"),
        Row("mean time a scan", [float(r.scan_ms.mean()) for r in deskewed], "ms", "A8"),
    ]
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


def pairwise(seeds: Sequence[int]) -> Section:
    """A8: scans matched to a map of all before them, or each to the one before it."""
    world = build_world("ring")
    seconds = PAIRED_SCANS / (0.5 * LMS100_50HZ.rate_hz)
    off: dict[str, list[float]] = {name: [] for name in (OURS, INERTIAL, PAIRS)}
    for seed in seeds:
        begun = begun_beside(world, *phase_m(seed))
        ride = thinned(drive(begun, LMS100_50HZ, seconds, seed), 2)
        with_imu = drive(begun, UTM30LX_40HZ, seconds, seed, imu=Imu())
        paired = {"profile": "imle", "components": {"matcher": "icp_scan_to_scan"}}
        for name, ran in (
            (OURS, mapped(ride)),
            (INERTIAL, run(mapping_config({"profile": "owolm_eskf"}), with_imu)),
            (PAIRS, run(mapping_config(paired), ride)),
        ):
            off[name].append(ran.end_error[0])
    path_m = float(np.hypot(ride.truth[max(ride.truth)].x_m, ride.truth[max(ride.truth)].y_m))
    rows = [Row(f"{name}: off at the end", values, "m", "A8") for name, values in off.items()]
    for name in (OURS, INERTIAL):
        ratios = [pairs / ours for pairs, ours in zip(off[PAIRS], off[name], strict=True)]
        rows.append(
            Row(
                f"error of pairwise ICP by that of {name}",
                ratios,
                "times",
                "A8",
                at_least=1.0,
                by_worst=True,
                digits=1,
                cause=BIASED,
            )
        )
    return Section(
        "Matched to the map, or scan to scan",
        f"The first {PAIRED_SCANS} scans of the ring, {path_m:.0f} m along its first corridor. `contour_lm` "
        "and ICP of each scan to the one before it (point to point, all points, that of the profile `imle`) "
        "get 25 scans a second of an LMS100 alone, `owolm_eskf` 40 of a UTM-30LX and an IMU, as long. "
        "Along bare walls the nearest points are those beside, so that ICP of pairs of scans estimates no "
        "motion.",
        rows,
    )


def turns(seeds: Sequence[int]) -> Section:
    """A6 A31."""
    plan = Plan()
    plan.line((-4.0, -3.0), (4.0, -3.0), (4.0, 3.0), (-4.0, 3.0), (-4.0, -3.0))
    for x, y in ((2.5, 1.5), (-3.0, -1.0), (1.0, -2.4)):
        plan.box((x, y), (0.6, 0.4), 20.0)
    limits = Limits(turn_rate_radps=TURN_RADPS, turn_acceleration_radps2=2.0)
    spins = plan_drive(SE2(), [Spin(4.0 * math.pi), Pause(1.0)], limits)
    world = make_world("turns", plan, [], spins)
    rate, scatter, steady, ramps = [], [], [], []
    for seed in seeds:
        ride = at_phase(world, spins.duration_s + 0.5, seed)
        ran = mapped(ride)
        stamps = np.array([output.stamp_ns for output in ran.outputs])
        heading = np.unwrap([ride.truth[stamp].theta_rad for stamp in stamps.tolist()])
        true = np.gradient(heading, 1e-9 * stamps)
        found = np.array([output.twist_base[2] for output in ran.outputs])
        turning = np.abs(true - TURN_RADPS) < 1e-3
        ramping = np.abs(np.gradient(true, 1e-9 * stamps)) > 1.9
        rate.append(100.0 * abs(float(found[turning].mean()) / TURN_RADPS - 1.0))
        scatter.append(100.0 * float(found[turning].std()) / TURN_RADPS)
        off = np.hypot(*ran.errors[:, :2].T) + AT_M * np.abs(ran.errors[:, 2])
        steady.append(float(off[turning].mean()))
        ramps.append(float(off[ramping].mean()))
    return Section(
        "Turning on the spot",
        "A room of 8 x 6 m, two turns at 90 deg/s, with 2 rad/s² at the beginning and the "
        "end; laser alone, every scan of "
        f"50 Hz. Errors are those of a place {AT_M:g} m away.",
        [
            Row("mean turn rate found at 90 deg/s: off by", rate, "%", "A31", at_most=1.0, digits=2),
            Row("its scatter, scan by scan", scatter, "%", "A31", digits=2),
            Row("mean error while the rate is constant", steady, "m", "A6"),
            Row("mean error while it changes by 2 rad/s²", ramps, "m", "A6"),
        ],
    )


def before_return(what: Run, ride: Drive) -> float:
    """m: error of the position at the last scan till the base is within RETURN_M of the first leg (y = 0)."""
    away = [k for k, output in enumerate(what.outputs) if ride.truth[output.stamp_ns].y_m > RETURN_M]
    return float(np.hypot(*what.errors[away[-1], :2]))


def corridor(seeds: Sequence[int]) -> Section:
    """A50."""
    world = build_world("corridor100")
    rides = [at_phase(world, world.drive.duration_s + 0.5, seed) for seed in seeds[:LONG_SEEDS]]
    runs = [mapped(thinned(ride, 4)) for ride in rides]
    return Section(
        "Corridor of 100 m, out and back",
        "Laser alone, no loop closing, every fourth scan of 50 Hz.",
        [
            Row("end of the drive", [r.end_error[0] for r in runs], "m", "A50", at_most=0.10, by_worst=True),
            Row(
                "heading there",
                [float(np.degrees(r.end_error[1])) for r in runs],
                "°",
                "A50",
                at_most=0.5,
                by_worst=True,
            ),
            Row("position, RMS over 194 m", [r.position_rmse_m for r in runs], "m", "A50"),
        ],
        ran_on=seeds_text(seeds[:LONG_SEEDS]),
    )


def recorded(seeds: Sequence[int]) -> Section:  # recordings: seeds change nothing
    """A50 by another simulator."""
    rows = []
    for name in ("corridor100d_s1", "ring_s3"):
        found = scored("contour_lm", name)
        if found is not None and found.closure_m is not None:
            rows += [
                Row(f"{name}: closure", [found.closure_m], "m", "A50", at_most=0.10),
                Row(f"{name}: ATE", [found.error_m], "m", "A50"),
            ]
    return Section(
        "Recorded corridors",
        "A corridor of 100 m with recessed doors, out and back, and a ring, by another simulator; with "
        "odometry, every scan of 50 Hz.",
        rows,
        ran_on="recordings",
    )


def lone_points(seeds: Sequence[int]) -> Section:  # recordings: seeds change nothing
    """A15."""
    rows = []
    for name in ("aces", "csail", "tshape_s2", "fgi_s1"):
        rows += error_row("A15", "without lone points: ", "contour_lm", name)
        lone = {"local_map": {"contours": {"lone_points": True}}}
        rows += error_row("A15", "with lone points: ", "contour_lm", name, settings=lone)
    return Section(
        "Points outside all contours",
        "Such points are left out of the map (default), or inserted as "
        "blobs (`lone_points: true`). aces and csail are "
        "real buildings, mean error of their relations, which are good to 5 to 10 cm; the others are of "
        "another simulator, ATE after the rigid motion that fits best.",
        rows,
        ran_on="recordings",
    )


SCENARIOS = {
    "niches": niches,
    "person": crossing,
    "lobby": crowd,
    "protect": protection,
    "lone_points": lone_points,
    "starts": lambda seeds: starts(niche_drive(seeds[0]), BEAMS, seeds[0]),
    "ring": ring,
    "corridor": corridor,
    "pairwise": pairwise,
    "recorded": recorded,
    "turns": turns,
}
