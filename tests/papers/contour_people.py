"""Li et al. 2016: a person who walks through a map that is learned."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from service.geometry.se2 import SE2
from service.mapper.papers.contour_lm.contour_map import ContourMap, ContourMapConfig
from simulators.trajectory import Pause, plan_drive
from simulators.world import Plan, World, make_world, walk
from tests.papers.contour_maps import BEAMS, Array, at_phase, grid, learn, offset_m, read
from tests.papers.pictures import draw_maps
from tests.papers.report import Row, Section
from tests.papers.true_poses import true_scans
from tests.simulated import LMS100_50HZ, Drive, begun_beside, drive

CROSSING_M = 3.0  # ahead of the vehicle
SHOWN_M = (-4.2, 10.2, -1.82, 1.82)  # the whole corridor
CROSSED_M = (CROSSING_M - 0.28, CROSSING_M - 0.08, -0.9, 0.9)  # the side of a person that is seen
NEAR_M = 5.5  # up to here neighbouring beams fall into neighbouring cells of 5 cm
WALLS = 0.97  # of 1: what of a wall is to stay
PHASES_M = np.arange(0.0, 0.05, 0.005)  # across a cell of learning_config


def crossed_corridor() -> World:
    plan = Plan()
    plan.line((-4.0, -1.62), (10.0, -1.62), (10.0, 1.62), (-4.0, 1.62), (-4.0, -1.62))
    person = walk([(CROSSING_M, -1.3), (CROSSING_M, 1.3)], 120.0, speed_mps=1.0, pause_s=110.0, begin_s=1.0)
    return make_world("crossed", plan, [person], plan_drive(SE2(), [Pause(1.0)], repeats=True))


def learning_config(update: str, fades: bool) -> ContourMapConfig:
    learning = {"update": update, "decrease": fades}
    return ContourMapConfig.model_validate({"levels": 1, "cell_m": 0.05, "learning": learning})


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


def crossing(seeds: Sequence[int]) -> Section:
    """A48: what is left where a person walked, and of the walls, with both updates."""
    world = crossed_corridor()
    rides = [at_phase(world, 24.0, seed) for seed in seeds]
    variants = (("printed", True), ("printed", False), ("averaged", True))
    maps = {variant: [learn(ride, learning_config(*variant)) for ride in rides] for variant in variants}
    cell_m = learning_config("printed", True).cell_m
    xy = grid(CROSSED_M, cell_m)
    places = [xy[~near_walls(world, xy, 0.25)] - offset_m(ride) for ride in rides]
    tracks = [at[read(made, at)[:, 0] > 0.5] for made, at in zip(maps["printed", False], places, strict=True)]
    walls = [seen_walls(ride, cell_m) for ride in rides]
    rows = []
    for (update, fades), made in maps.items():
        left = [float(read(one, track)[:, 0].mean()) for one, track in zip(made, tracks, strict=True)]
        what = f"{update}: tracks {'with' if fades else 'without'} decrease"
        if not fades:
            rows.append(Row("A48", what, left, "of 1", at_least=0.9))
            continue
        kept = [wall_mean(one, wall) for one, wall in zip(made, walls, strict=True)]
        rows += [
            Row("A48", what, left, "of 1", at_most=0.1),
            Row("A48", f"{update}: walls with decrease", kept, "of 1", at_least=WALLS, by_worst=True),
        ]
    config = learning_config("averaged", True)
    at_phases = [drive(begun_beside(world, 0.0, y_m), LMS100_50HZ, 6.0, seeds[0]) for y_m in PHASES_M]
    kept = [wall_mean(learn(ride, config), seen_walls(ride, config.cell_m)) for ride in at_phases]
    what = f"averaged: walls after 6 s at {len(PHASES_M)} phases to the cells, seed {seeds[0]}"
    rows.append(Row("A48", what, kept, "of 1", at_least=WALLS, by_worst=True))
    every = grid(SHOWN_M, cell_m)
    shown = {
        what: (every, read(maps["printed", fades][0], every - offset_m(rides[0]))[:, 0])
        for what, fades in (("without decrease", False), ("with decrease", True))
    }
    caption = f"The printed update, dark is 1, m, seed {seeds[0]} (A48)"
    return Section(
        "A person who crosses",
        "A vehicle stands in a corridor; a person crosses ahead of it at 1 m/s and is absent for the "
        "following 20 s. Cells of 5 cm, every scan learned at 50 Hz. Tracks are cells away from walls that "
        "are above one half in the printed map without decrease; walls are the likeliest cell around each "
        "place within 5.5 m that every scan of the last second hit. The profile's own update is `averaged`.",
        rows,
        pictures=[draw_maps("contour-person.png", caption, shown, cell_m, SHOWN_M)],
    )
