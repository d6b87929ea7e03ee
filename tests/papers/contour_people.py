"""Li et al. 2016: people who walk through a map that is learned."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from service.geometry.se2 import SE2
from service.mapper.papers.contour_lm.contour_map import ContourMap, ContourMapConfig
from simulators.trajectory import Pause, plan_drive
from simulators.world import Plan, Walk, World, make_world, walk
from tests.papers.contour_maps import BEAMS, Array, Window, at_phase, grid, learn, offset_m, read
from tests.papers.contour_pictures import draw_track
from tests.papers.report import Row, Section, seeds_text
from tests.papers.true_poses import true_scans
from tests.simulated import LMS100_50HZ, Drive, begun_beside, drive, off_walls_m

CROSSING_M = 3.0  # ahead of the vehicle
CROSSED_M = (CROSSING_M - 0.28, CROSSING_M - 0.08, -0.9, 0.9)  # the side of a person that returns the beams
WALKED_M = (0.8, 5.5, -2.3, 2.3)
LOBBY_SEED = 5
NEAR_M = 5.5  # up to here neighbouring beams fall into neighbouring cells of 5 cm
LOBBY_SEEDS = 3  # each takes a minute
WALLS = 0.97  # of 1: share of a wall's likelihood that is to stay
PHASES_M = np.arange(0.0, 0.05, 0.005)  # across a cell of learning_config


def crossed_corridor() -> World:
    plan = Plan()
    plan.line((-4.0, -1.62), (10.0, -1.62), (10.0, 1.62), (-4.0, 1.62), (-4.0, -1.62))
    person = walk([(CROSSING_M, -1.3), (CROSSING_M, 1.3)], 120.0, speed_mps=1.0, pause_s=110.0, begin_s=1.0)
    return make_world("crossed", plan, [person], plan_drive(SE2(), [Pause(1.0)], repeats=True))


def lobby() -> World:
    """Six people walk random paths before the vehicle, and are gone from the 60th second on.

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
    """A48, A49: likelihoods where people walked, and of the walls, with both updates."""
    rides = [at_phase(world, seconds, seed) for seed in seeds]
    variants = (("printed", True), ("printed", False), ("averaged", True))
    maps = {variant: [learn(ride, learning_config(*variant)) for ride in rides] for variant in variants}
    cell_m = learning_config("printed", True).cell_m
    xy = grid(walked_m, cell_m)
    xy = xy[off_walls_m(xy, world.segments) >= 0.25]
    places = [xy - offset_m(ride) for ride in rides]
    tracks = [at[read(made, at)[:, 0] > 0.5] for made, at in zip(maps["printed", False], places, strict=True)]
    walls = [seen_walls(ride, cell_m) for ride in rides]
    rows = []
    for update, fades in variants:
        made = maps[update, fades]
        left = [float(read(one, track)[:, 0].mean()) for one, track in zip(made, tracks, strict=True)]
        what = f"{update}: tracks {'with' if fades else 'without'} decrease"
        rows.append(
            Row(what, left, "of 1", ids, at_most=0.1) if fades else Row(what, left, "of 1", ids, at_least=0.9)
        )
        kept = [wall_mean(one, wall) for one, wall in zip(made, walls, strict=True)]
        if fades:
            rows.append(
                Row(f"{update}: walls with decrease", kept, "of 1", ids, at_least=WALLS, by_worst=True)
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
        ran_on=seeds_text(seeds),
        pictures=[draw_track(picture, shown, every, cell_m, window, ids, seeds[0])],
    )


def learning_config(update: str, fades: bool, protect_count: int = 1000) -> ContourMapConfig:
    learning = {"update": update, "decrease": fades, "protect_count": protect_count}
    return ContourMapConfig.model_validate({"levels": 1, "cell_m": 0.05, "learning": learning})


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


def crossing(seeds: Sequence[int]) -> Section:
    """A48."""
    world = crossed_corridor()
    section = people(
        "A person who crosses",
        "A vehicle stands in a corridor; a person crosses ahead of it at 1 m/s and is absent for the "
        "following 20 s.",
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
    rows = [*section.rows, Row(what, kept, "of 1", "A48", at_least=WALLS, by_worst=True)]
    return replace(section, rows=rows)


def crowd(seeds: Sequence[int]) -> Section:
    """A49."""
    return people(
        "Six people in a lobby",
        "A vehicle stands in a lobby of 12 x 8 m; six people walk for 60 s and are absent for the following "
        "20 s.",
        "A49",
        lobby(),
        81.0,
        seeds[:LOBBY_SEEDS],
        WALKED_M,
        "contour-lobby.png",
    )


def protection(seeds: Sequence[int]) -> Section:
    """A38."""
    world, seed = lobby(), seeds[0]
    ride = at_phase(world, 81.0, seed)
    config = learning_config("printed", False)
    xy = grid(WALKED_M, config.cell_m)
    at = xy[off_walls_m(xy, world.segments) >= 0.25] - offset_m(ride)
    tracks = at[read(learn(ride, config), at)[:, 0] > 0.5]
    rows = []
    for count in (100, 500, 1000):
        made = learn(ride, learning_config("averaged", True, count))
        left = float(read(made, tracks)[:, 0].mean())
        kept = wall_mean(made, seen_walls(ride, config.cell_m))
        rows += [
            Row(f"n_th {count}: tracks", [left], "of 1", "A38"),
            Row(f"n_th {count}: walls", [kept], "of 1", "A38"),
        ]
    return Section(
        "Number of scans after which a cell is protected",
        "The lobby again, with the profile's own update: a cell that was hit in more than n_th scans is not "
        "decreased any more.",
        rows,
        ran_on=seeds_text([seed]),
    )
