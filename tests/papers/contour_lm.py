"""Paper 000: niches, people who walk through, a ring with and without deskewing, a long corridor and back.

The maps of niches and people are fed with true poses, so their figures are their own and not the matcher's.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np

from service.geometry.se2 import SE2
from service.kernels.contours import extract_contours
from service.kernels.surfels import TILE_CELLS
from service.mapper.filters.deskew import BeamsConfig
from service.mapper.methods.contour_lm.contour_map import ContourMap, ContourMapConfig
from service.mapper.profiles import mapping_config
from simulators.trajectory import Follow, Pause, plan_drive
from simulators.world import Plan, Walk, World, make_world, walk
from simulators.worlds import build_world
from tests.papers.contour_pictures import draw_niches, draw_scan, draw_track
from tests.papers.contour_search import starts
from tests.papers.report import Row, Section, told
from tests.papers.true_poses import true_scans
from tests.simulated import LMS100_50HZ, Drive, Run, begun_beside, drive, phase_m, run

Array = np.ndarray
BEAMS = BeamsConfig(nearest_m=0.5, farthest_m=20.0)  # of the profile
NICHES = (1.5, 4.0, 6.5)  # m along each side, 0.9 m wide and 0.25 m deep
CROSSING_M = 3.0  # ahead of the vehicle
Window = tuple[float, float, float, float]  # x0, x1, y0, y1, m
CROSSED_M = (CROSSING_M - 0.28, CROSSING_M - 0.08, -0.9, 0.9)  # the side of a person that is seen
WALKED_M = (0.8, 5.5, -2.3, 2.3)
LOBBY_SEED = 5
NEAR_M = 5.5  # up to here neighbouring beams fall into neighbouring cells of 5 cm
LONG_SEEDS = 2  # of the corridor of 100 m, and LOBBY_SEEDS of the lobby: each takes a minute
LOBBY_SEEDS = 3
RETURN_M = 2.0
WALLS = 0.97  # of 1: what of a wall is to stay
PHASES_M = np.arange(0.0, 0.05, 0.005)  # across a cell of learning_config
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


def crossed_corridor() -> World:
    plan = Plan()
    plan.line((-4.0, -1.62), (10.0, -1.62), (10.0, 1.62), (-4.0, 1.62), (-4.0, -1.62))
    person = walk([(CROSSING_M, -1.3), (CROSSING_M, 1.3)], 120.0, speed_mps=1.0, pause_s=110.0, begin_s=1.0)
    return make_world("crossed", plan, [person], plan_drive(SE2(), [Pause(1.0)], repeats=True))


def lobby() -> World:
    """Six people walk random ways before the vehicle, and are gone from the 60th second on.

    They stay where neighbouring beams are less than a cell of 5 cm apart: each cell they leave is seen.
    """
    plan = Plan()
    plan.line((-2.0, -4.0), (10.0, -4.0), (10.0, 4.0), (-2.0, 4.0), (-2.0, -4.0))
    for y in (-2.8, 2.8):
        plan.box((5.0, y), (0.4, 0.4))
    noise = np.random.default_rng(LOBBY_SEED)
    people = []
    for _ in range(6):
        now_s, here = 0.0, (float(noise.uniform(1.0, 5.2)), float(noise.uniform(-2.0, 2.0)))
        times_s, places = [0.0], [here]
        while True:
            there = (float(noise.uniform(1.0, 5.2)), float(noise.uniform(-2.0, 2.0)))
            now_s += float(np.hypot(there[0] - here[0], there[1] - here[1])) / float(noise.uniform(0.7, 1.3))
            if now_s > 60.0:
                break
            times_s.append(now_s)
            places.append(there)
            here = there
        times_s += [60.0, 60.1, 199.9, 200.0]
        places += [here, (50.0, 0.0), (50.0, 0.0), places[0]]
        people.append(Walk(tuple(times_s), tuple(places)))
    return make_world("lobby", plan, people, plan_drive(SE2(), [Pause(1.0)], repeats=True))


def learn(what: Drive, config: ContourMapConfig, every: int = 1) -> ContourMap:
    """The map of a drive at its true poses."""
    local_map = ContourMap(config)
    for points, match in true_scans(what, BEAMS, every):
        local_map.insert(points, match)
    return local_map


def read(local_map: ContourMap, xy: Array) -> Array:
    """(N, 2) likelihood, and the highest ever, of the cells of places in the frame of the first scan."""
    level = local_map.level(0)
    cells = np.floor(xy / level.cell_m).astype(int)
    values = np.zeros((len(xy), 2))
    for k, (column, row) in enumerate(cells):
        tile = (row // TILE_CELLS - level.tiles.origin[0], column // TILE_CELLS - level.tiles.origin[1])
        if not (0 <= tile[0] < level.tiles.slots.shape[0] and 0 <= tile[1] < level.tiles.slots.shape[1]):
            continue
        slot = level.tiles.slots[tile]
        if slot >= 0:
            place = (slot, row % TILE_CELLS, column % TILE_CELLS)
            values[k] = level.likelihood[place], level.highest[place]
    return values


def grid(window: tuple[float, float, float, float], cell_m: float) -> Array:
    """(N, 2) m, centres of the cells of x0, x1, y0, y1."""
    x = np.arange(window[0] + 0.5 * cell_m, window[1], cell_m)
    y = np.arange(window[2] + 0.5 * cell_m, window[3], cell_m)
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def config_of(
    cell_m: float = 0.025, contours: dict[str, float] | None = None, **blur: object
) -> ContourMapConfig:
    return ContourMapConfig.model_validate(
        {"levels": 1, "cell_m": cell_m, "contours": contours or {}, "blur": blur}
    )


def at_phase(world: World, seconds: float, seed: int) -> Drive:
    """Walls lie in the cells of the map as the seed says."""
    return drive(begun_beside(world, *phase_m(seed)), LMS100_50HZ, seconds, seed)


def offset_m(what: Drive) -> Array:
    """(2,) where the map's frame begins in the frame of the world; both have the same axes here."""
    return np.array([what.world_first.x_m, what.world_first.y_m])


@cache
def niche_drive(seed: int) -> Drive:
    return at_phase(niche_corridor(), 9.0, seed)


def in_the_mouths(what: Drive, config: ContourMapConfig) -> float:
    """Mean likelihood of cells in the mouths of the niches, more than 5 cm from any surface (A46)."""
    x = np.concatenate([np.arange(at + 0.06, at + 0.84, 0.02) for at in NICHES]) - 1.0
    xy = np.array([(u, side * v) for u in x for v in np.arange(0.97, 1.05, 0.02) for side in (-1.0, 1.0)])
    return float(read(learn(what, config, 5), xy - offset_m(what))[:, 0].mean())


def niches(seeds: Sequence[int]) -> Section:
    """A46 A10, and A19 by the way."""

    def mouths(config: ContourMapConfig) -> list[float]:
        return [in_the_mouths(niche_drive(seed), config) for seed in seeds]

    def share(config: ContourMapConfig, base: list[float]) -> list[float]:
        return [value / other for value, other in zip(mouths(config), base, strict=True)]

    traditional = mouths(config_of(contours=JOINED, traditional=True))
    rows = [
        Row("A46 A10", "traditional contour map, likelihood in the mouths", traditional, "of 1"),
        Row("A46", "the profile, share of that", share(config_of(), traditional), "of 1", at_most=0.5),
        Row(
            "A46",
            "the profile's blur on the contours of the traditional map, share",
            share(config_of(contours=JOINED), traditional),
            "of 1",
        ),
    ]
    for cell_m in (0.01, 0.025, 0.05):
        base = in_the_mouths(niche_drive(seeds[0]), config_of(cell_m, JOINED, traditional=True))
        for along, across in ((10.0, 1.5), (1.5, 10.0)):
            config = config_of(cell_m, along_cells=along, across_cells=across)
            what = f"cells of {100 * cell_m:g} cm, {along:g} along, {across:g} across: share, seed {seeds[0]}"
            rows.append(Row("A19", what, [in_the_mouths(niche_drive(seeds[0]), config) / base], "of 1"))
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
        "learned. The traditional map joins neighbouring points up to 1 m apart, and its contours are as "
        "likely between points as at them; the profile joins up to 15 cm (eq. 5), and likelihood falls "
        "between points. Rows without a bound are for comparison.",
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
    return draw_scan(points.xy_base, contour, maps, cells, 0.025, window)


def people(
    title: str,
    text: str,
    ids: str,
    world: World,
    seconds: float,
    seeds: Sequence[int],
    walked_m: Window,
    picture: str,
) -> Section:
    """A48, A49: what is left where people walked, and of the walls, with both updates."""
    rides = [at_phase(world, seconds, seed) for seed in seeds]
    variants = (("printed", True), ("printed", False), ("averaged", True))
    maps = {variant: [learn(ride, learning_config(*variant)) for ride in rides] for variant in variants}
    cell_m = learning_config("printed", True).cell_m
    xy = grid(walked_m, cell_m)
    xy = xy[~near_walls(world, xy, 0.25)]
    places = [xy - offset_m(ride) for ride in rides]
    tracks = [at[read(made, at)[:, 0] > 0.5] for made, at in zip(maps["printed", False], places, strict=True)]
    walls = [seen_walls(ride, cell_m) for ride in rides]
    rows = []
    for update, fades in variants:
        made = maps[update, fades]
        left = [float(read(one, track)[:, 0].mean()) for one, track in zip(made, tracks, strict=True)]
        what = f"{update}: tracks {'with' if fades else 'without'} decrease"
        rows.append(
            Row(ids, what, left, "of 1", at_most=0.1) if fades else Row(ids, what, left, "of 1", at_least=0.9)
        )
        kept = [wall_mean(one, wall) for one, wall in zip(made, walls, strict=True)]
        if fades:
            rows.append(
                Row(ids, f"{update}: walls with decrease", kept, "of 1", at_least=WALLS, by_worst=True)
            )
    corners = world.segments.reshape(-1, 2)
    (x0, y0), (x1, y1) = corners.min(axis=0).tolist(), corners.max(axis=0).tolist()
    window = (x0 - 0.2, x1 + 0.2, y0 - 0.2, y1 + 0.2)
    every = grid(window, cell_m)
    shown = {
        "without decrease": read(maps["printed", False][0], every - offset_m(rides[0]))[:, 0],
        "with decrease": read(maps["printed", True][0], every - offset_m(rides[0]))[:, 0],
    }
    return Section(
        title,
        f"{text} Cells of 5 cm, every scan learned at 50 Hz. Tracks are cells away from walls that are above "
        "one half in the printed map without decrease; walls are the likeliest cell around each place within "
        "5.5 m that every scan of the last second hit. The profile's own update is `averaged`.",
        rows,
        ran_on=told(seeds),
        pictures=[draw_track(picture, shown, every, cell_m, window, ids, seeds[0])],
    )


def learning_config(update: str, fades: bool) -> ContourMapConfig:
    return ContourMapConfig.model_validate(
        {"levels": 1, "cell_m": 0.05, "learning": {"update": update, "decrease": fades}}
    )


def near_walls(world: World, xy: Array, within_m: float) -> Array:
    """(N,) whether a place lies so near a wall."""
    near = np.zeros(len(xy), np.bool_)
    for x0, y0, x1, y1 in world.segments:
        way, off = np.array([x1 - x0, y1 - y0]), xy - (x0, y0)
        along = np.clip(off @ way / (way @ way), 0.0, 1.0)
        near |= np.hypot(*(off - along[:, None] * way).T) < within_m
    return near


def seen_walls(ride: Drive, cell_m: float) -> Array:
    """(N, 2) m: one place a cell along each beam direction that returned from the same wall all along."""
    scans = [points.xy_base for points, _ in true_scans(replace(ride, frames=ride.frames[-51:]), BEAMS)]
    places = np.round(scans[-1] / cell_m).astype(int)
    counts: dict[tuple[int, int], int] = {}
    for xy in scans:
        for column, row in {tuple(cell) for cell in np.round(xy / cell_m).astype(int).tolist()}:
            for u in (-1, 0, 1):
                for v in (-1, 0, 1):
                    key = (column + u, row + v)
                    counts[key] = counts.get(key, 0) + 1
    kept = [cell for cell in {tuple(c) for c in places.tolist()} if counts.get(cell, 0) >= len(scans)]
    walls = np.array(kept) * cell_m
    return walls[np.hypot(*walls.T) < NEAR_M]


def wall_mean(local_map: ContourMap, places: Array) -> float:
    """Mean over places on walls of the likeliest of the nine cells around each."""
    cell_m = local_map.level(0).cell_m
    steps = cell_m * np.array([(u, v) for u in (-1, 0, 1) for v in (-1, 0, 1)])
    around = (places[:, None, :] + steps[None]).reshape(-1, 2)
    return float(read(local_map, around)[:, 0].reshape(len(places), -1).max(axis=1).mean())


def mapped(what: Drive, without_motion: bool = False, **matcher: object) -> Run:
    config = mapping_config({"profile": "contour_lm", "settings": {"matcher": matcher}})
    return run(config, what, without_motion=without_motion)


def thinned(what: Drive, every: int) -> Drive:
    return replace(what, frames=what.frames[::every])


def ring(seeds: Sequence[int]) -> Section:
    """A47 A5."""
    world = build_world("ring")
    rides = [thinned(at_phase(world, world.drive.duration_s + 0.5, seed), 2) for seed in seeds]
    deskewed = [mapped(ride) for ride in rides]
    raw = [mapped(ride, without_motion=True) for ride in rides]
    literal = mapped(rides[0], beam_time="printed")
    closure, closure_raw = ([r.end_error[0] for r in runs] for runs in (deskewed, raw))
    drift, drift_raw = (
        [before_return(r, ride) for r, ride in zip(runs, rides, strict=True)] for runs in (deskewed, raw)
    )
    return Section(
        "Ring of 100 m",
        "30 x 20 m, 2 m wide, at 1.2 m/s, corners at about 70 deg/s; laser alone, no loop closing, every "
        "second scan of 50 Hz. Without deskewing, sweeps are taken for instants. Past the last corner scans "
        "are matched to the first walls again, which takes drift away; the error before it keeps it.",
        [
            Row("A47", "closure with deskewing", closure, "m"),
            Row("A47", "closure without", closure_raw, "m"),
            Row(
                "A47", "median with by median without", [share_of(closure, closure_raw)], "times", at_most=0.5
            ),
            Row("A47", "error before the last corner, with", drift, "m"),
            Row("A47", "error before the last corner, without", drift_raw, "m"),
            Row("A47", "median with by median without", [share_of(drift, drift_raw)], "times", at_most=0.5),
            Row("A47", "position, RMS, with", [r.position_rmse_m for r in deskewed], "m"),
            Row("A47", "position, RMS, without", [r.position_rmse_m for r in raw], "m"),
            Row(
                "A5",
                f"closure with the printed time between beams, seed {seeds[0]}",
                [literal.end_error[0]],
                "m",
            ),
            Row("A5", "position, RMS, with that", [literal.position_rmse_m], "m"),
            Row("A8", "mean time a scan", [float(r.scan_ms.mean()) for r in deskewed], "ms", digits=1),
        ],
    )


def before_return(what: Run, ride: Drive) -> float:
    """m: error of the position at the last scan till the base is within RETURN_M of the first leg (y = 0)."""
    away = [k for k, output in enumerate(what.outputs) if ride.truth[output.stamp_ns].y_m > RETURN_M]
    return float(np.hypot(*what.errors[away[-1], :2]))


def share_of(some: list[float], others: list[float]) -> float:
    return float(np.median(some) / np.median(others))


def corridor(seeds: Sequence[int]) -> Section:
    """A50."""
    world = build_world("corridor100")
    rides = [at_phase(world, world.drive.duration_s + 0.5, seed) for seed in seeds[:LONG_SEEDS]]
    runs = [mapped(thinned(ride, 4)) for ride in rides]
    return Section(
        "Corridor of 100 m, out and back",
        "Laser alone, no loop closing, every fourth scan of 50 Hz.",
        [
            Row("A50", "end of the drive", [r.end_error[0] for r in runs], "m", at_most=0.10, by_worst=True),
            Row(
                "A50",
                "heading there",
                [float(np.degrees(r.end_error[1])) for r in runs],
                "°",
                at_most=0.5,
                by_worst=True,
            ),
            Row("A50", "position, RMS over 194 m", [r.position_rmse_m for r in runs], "m"),
        ],
        ran_on=told(seeds[:LONG_SEEDS]),
    )


def crossing(seeds: Sequence[int]) -> Section:
    """A48."""
    world = crossed_corridor()
    section = people(
        "A person who crosses",
        "A vehicle stands in a corridor; somebody crosses ahead of it at 1 m/s and is away for 20 s.",
        "A48",
        world,
        24.0,
        seeds,
        CROSSED_M,
        "contour-person.png",
    )
    config = learning_config("averaged", True)
    rides = [drive(begun_beside(world, 0.0, y_m), LMS100_50HZ, 6.0, seeds[0]) for y_m in PHASES_M]
    kept = [wall_mean(learn(ride, config), seen_walls(ride, config.cell_m)) for ride in rides]
    what = f"averaged: walls after 6 s at {len(PHASES_M)} phases to the cells, seed {seeds[0]}"
    rows = [*section.rows, Row("A48", what, kept, "of 1", at_least=WALLS, by_worst=True)]
    return replace(section, rows=rows)


def crowd(seeds: Sequence[int]) -> Section:
    """A49."""
    return people(
        "Six people in a lobby",
        "A vehicle stands in a lobby of 12 x 8 m; six people walk about for 60 s and are gone for 20 s.",
        "A49",
        lobby(),
        81.0,
        seeds[:LOBBY_SEEDS],
        WALKED_M,
        "contour-lobby.png",
    )


SCENARIOS = {
    "niches": niches,
    "person": crossing,
    "lobby": crowd,
    "starts": lambda seeds: starts(niche_drive(seeds[0]), BEAMS, seeds[0]),
    "ring": ring,
    "corridor": corridor,
}
