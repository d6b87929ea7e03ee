"""Paper 000: what contours, blur and learning make of niches and of somebody who walks through.

The map is fed with true poses, so that its figures are its own and not those of the matcher.
"""

from collections.abc import Iterable
from functools import cache

import numpy as np

from service.fusion.motion import Motion
from service.geometry.se2 import SE2
from service.kernels.surfels import TILE_CELLS
from service.mapper.filters.deskew import BeamsConfig, DeskewByTwist
from service.mapper.maps.contour_map import ContourMap, ContourMapConfig
from service.mapper.stages import Match
from simulators.trajectory import Follow, Pause, plan_drive
from simulators.world import Plan, World, make_world, walk
from tests.papers.report import Row, Section
from tests.simulated import FORWARD, LMS100_50HZ, Drive, drive

NICHES = (1.5, 4.0, 6.5)  # m along each side, 0.9 m wide and 0.25 m deep
TRACK = ((3.0, -0.9), (3.0, 0.9))  # m; the walk crosses the corridor ahead of the standing vehicle


def niche_corridor() -> World:
    """A corridor 2 m wide with three sunk doors a side, and a corner of 90 deg at its end."""
    plan = Plan()
    plan.sunk_doors((0.0, -1.0), (12.0, -1.0), NICHES, depth=-0.25)
    plan.sunk_doors((0.0, 1.0), (10.0, 1.0), NICHES, depth=0.25)
    plan.line((12.0, -1.0), (12.0, 8.0), (10.0, 8.0), (10.0, 1.0))
    plan.line((0.0, -1.0), (0.0, 1.0))
    return make_world("niches", plan, [], plan_drive(SE2(1.0, 0.0, 0.0), [Follow([(9.0, 0.0)]), Pause(1.0)]))


def crossed_corridor() -> World:
    """A standing vehicle; a person crosses ahead of it once a minute."""
    plan = Plan()
    plan.line((-4.0, -1.6), (10.0, -1.6), (10.0, 1.6), (-4.0, 1.6), (-4.0, -1.6))
    person = walk([(3.0, -1.3), (3.0, 1.3)], 120.0, speed_mps=1.0, pause_s=110.0, begin_s=1.0)
    return make_world("crossed", plan, [person], plan_drive(SE2(), [Pause(1.0)], repeats=True))


def learn(what: Drive, config: ContourMapConfig, every: int = 1) -> ContourMap:
    """The map of a drive at its true poses."""
    deskew, local_map = DeskewByTwist(BeamsConfig(nearest_m=0.5), {"front": FORWARD}), ContourMap(config)
    scans = what.frames[:-1:every]
    for scan, after in zip(scans, what.frames[1::every], strict=False):
        pose = what.truth[scan.stamp_ns]
        step = (pose.inverse() @ what.truth[after.stamp_ns]).log()
        forward, left, turn = (rate / ((after.stamp_ns - scan.stamp_ns) * 1e-9) for rate in step)
        motion = Motion(pose, (forward, left, turn), np.eye(3))
        points = deskew(scan, motion)
        local_map.insert(points, Match(motion, points, 1.0))
    return local_map


def read(local_map: ContourMap, xy: np.ndarray) -> np.ndarray:
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


def config_of(update: str = "averaged", **blur: object) -> ContourMapConfig:
    return ContourMapConfig.model_validate({"levels": 1, "learning": {"update": update}, "blur": blur})


@cache
def niche_drive(seed: int) -> Drive:
    return drive(niche_corridor(), LMS100_50HZ, 9.0, seed)


def in_the_mouths(local_map: ContourMap) -> float:
    """Mean likelihood of cells in the mouths of the niches, more than 5 cm from any surface (A46)."""
    x = np.concatenate([np.arange(at + 0.06, at + 0.84, 0.02) for at in NICHES]) - 1.0
    xy = np.array([(u, side * v) for u in x for v in np.arange(0.97, 1.05, 0.02) for side in (-1.0, 1.0)])
    return float(read(local_map, xy)[:, 0].mean())


def niches(seeds: int) -> Section:
    """A46, and A19 by the way."""
    traditional = [
        in_the_mouths(learn(niche_drive(s + 1), config_of(traditional=True), 5)) for s in range(seeds)
    ]
    rows = []
    for name, blur, bound in (
        ("along 10, across 1.5 cells (default)", {}, 0.5),
        ("along 1.5, across 1.5 cells", {"along_cells": 1.5}, None),
        ("along 1.5, across 10 cells (as printed)", {"along_cells": 1.5, "across_cells": 10.0}, 0.5),
    ):
        share = [
            in_the_mouths(learn(niche_drive(s + 1), config_of(**blur), 5)) / traditional[s]
            for s in range(seeds)
        ]
        rows.append(Row("A46 A19", f"{name}, share of the traditional map", share, "", bound))
    rows.append(Row("A46 A10", "traditional contour map, likelihood in the mouths", traditional, ""))
    return Section(
        "Niches",
        "A corridor 2 m wide with six niches of 0.25 x 0.9 m, driven past at true poses; every fifth scan "
        "is learned. The row without a bound is for comparison.",
        rows,
    )


@cache
def crossing(seed: int) -> Drive:
    return drive(crossed_corridor(), LMS100_50HZ, 24.0, seed)


def left_of_the_person(seed: int, update: str, decrease: bool) -> tuple[float, float]:
    """Mean likelihood on the track where it once was above one half, and on the walls in view (A48)."""
    config = ContourMapConfig.model_validate(
        {"levels": 1, "cell_m": 0.05, "learning": {"update": update, "decrease": decrease, "bounded": True}}
    )
    local_map = learn(crossing(seed), config)
    y = np.arange(TRACK[0][1], TRACK[1][1], 0.05)
    track = read(local_map, np.array([(x, v) for v in y for x in np.arange(2.72, 2.9, 0.05)]))
    walls = np.array(
        [
            [(x, side * v) for v in (1.53, 1.58, 1.62, 1.67)]
            for x in np.arange(1.0, 5.0, 0.1)
            for side in (-1, 1)
        ]
    )
    best = read(local_map, walls.reshape(-1, 2))[:, 0].reshape(len(walls), -1).max(axis=1)
    return float(track[track[:, 1] > 0.5, 0].mean()), float(best.mean())


def pedestrian(seeds: int) -> Section:
    """A48, with the update of the paper and that of the profile."""
    rows = []
    for update in ("printed", "averaged"):
        faded = [left_of_the_person(s + 1, update, True) for s in range(seeds)]
        kept = [left_of_the_person(s + 1, update, False) for s in range(seeds)]
        rows += [
            Row("A48", f"{update}: track with decrease", [f[0] for f in faded], "", at_most=0.1),
            Row(
                "A48",
                f"{update}: track without",
                [f[0] for f in kept],
                "",
                at_least=0.9 if update == "printed" else None,
            ),
            Row("A48", f"{update}: walls with decrease", [f[1] for f in faded], "", at_least=0.95),
        ]
    return Section(
        "A person who crosses",
        "A vehicle stands; somebody crosses 3 m ahead of it at 1 m/s and is away for 20 s. Cells of 5 cm.",
        rows,
    )


def sections(seeds: int) -> Iterable[Section]:
    yield niches(seeds)
    yield pedestrian(seeds)
