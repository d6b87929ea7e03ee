"""Zhang et al. 2016: one precision in worlds of 300, 2000 and 12 000 m2; a single map beside."""

import json
import pickle
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np

from drivers.frames import LaserScan
from service.geometry.poses import points_from
from service.geometry.se2 import SE2
from service.mapper.corrections import corrected
from service.mapper.profiles import build_mapper, mapping_config
from service.offline.score.score import align
from simulators.world import World
from simulators.worlds.floor import floor
from simulators.worlds.mall import mall
from simulators.worlds.office import office
from tests.papers.pictures import draw_scale, end_points, plt, save
from tests.papers.report import Row, Section, seeds_text
from tests.papers.submap_hours import CART, mapper_and_back_ends
from tests.simulated import FORWARD, Drive, Wheels, begun_beside, drive, phase_m

CHECK_POINTS = 20
BESIDE_M = 0.15  # end points that give the position of a check point in the map
SEEN = 4  # scans that see a place, at least
NEAR_M = 8.0  # returns from farther away are left out of it
EVERY = 5  # scans: so many as one are asked where walls are
SINGLE = {"local_map": {"length_m": 1e6}}
SHORT = "on a lap of 115 m one map drifts by centimetres only before it meets its first walls again"
KEEPS = "the scans of every pass are kept, packed, for landmarks and to draw the map again"
AROUND = {"matcher": {"draw": "around_scan"}}


@dataclass(frozen=True)
class Place:
    name: str
    area_m2: int
    world: Callable[[int], World]  # from the seed
    seconds: float
    seeds: int  # at most so many: the largest takes minutes each


OFFICE = Place("office", 300, lambda _: office(), 60.0, 5)
FLOOR = Place("floor", 2000, lambda seed: floor(layout=seed), 260.0, 3)
LAP_COUNT = 4
LAPS = Place("office", 300, lambda _: office(), LAP_COUNT * office().drive.duration_s, 1)
MALL = Place("mall", 12_000, lambda _: mall(), 1250.0, 3)


@dataclass(frozen=True)
class Mapped:
    """Of the check points: greatest error after a rigid fit, that of distances between them; cost."""

    worst_m: float
    distance_m: float
    scan_ms: float
    poses: dict[int, SE2]  # by stamp, in the map


@cache
def driven(place: Place, seed: int) -> Drive:
    world = begun_beside(place.world(seed), *phase_m(seed))
    return drive(world, CART, place.seconds, seed, Wheels(scale=1.01, turn_scale=1.01))


@cache
def in_submaps(place: Place, seed: int) -> Mapped:
    return run(driven(place, seed))


@cache
def in_one_map(place: Place, seed: int) -> Mapped:
    return run(driven(place, seed), SINGLE, graph=False)


def precision(place: Place, seeds: Sequence[int]) -> Section:
    """D19."""
    found = [in_submaps(place, seed) for seed in seeds[: place.seeds]]
    rows = [
        Row(f"worst of {CHECK_POINTS} check points", worst(found), "m", "D19", at_most=0.10, by_worst=True),
        Row("worst distance between two", distances(found), "m", "D19", at_most=0.10, by_worst=True),
        Row("CPU a scan", [one.scan_ms for one in found], "ms"),
    ]
    return Section(
        f"The {place.name}, {place.area_m2} m2",
        "A cart with an LMS100 at 5 sweeps a second, wheels 1 % off, 30 particles. "
        f"{CHECK_POINTS} places on true walls, as far apart as the observed area allows, are compared with "
        "their places in the map, in the median of the scans that see them: after a rigid fit, and by the "
        "distances between all of them.",
        rows,
        ran_on=seeds_text(seeds[: place.seeds]),
    )


def weights(seeds: Sequence[int]) -> Section:
    """D2."""
    rows, rides = [], seeds[:3]
    for place in (OFFICE, FLOOR):
        aligned = [in_one_map(place, seed) for seed in rides], [in_submaps(place, seed) for seed in rides]
        around = (
            [run(driven(place, seed), SINGLE | AROUND, graph=False) for seed in rides],
            [run(driven(place, seed), AROUND) for seed in rides],
        )
        for name, (single, whole) in (
            ("aligned, weighted by the scan", aligned),
            ("around the scan, p / q", around),
        ):
            rows += [
                Row(f"{place.name}, {name}: one map, worst check point", worst(single), "m", "D2"),
                Row(f"{place.name}, {name}: sub-maps, worst check point", worst(whole), "m", "D2"),
            ]
    return Section(
        "Weight of a particle",
        "The paper weights by p / q (eq. "
        "2). The profile draws from the motion model, aligns each particle with its map and weights it by "
        "the likelihood of the scan there to the power of 0.1: the density q of a sample that was moved is "
        "not known. `draw: around_scan` draws from a Gaussian around the best pose of the scan and weights "
        "by p / q.",
        rows,
        ran_on=seeds_text(seeds[:3]),
    )


def against_single(seeds: Sequence[int]) -> Section:
    """D18, D20: a floor as one map that is never closed and never corrected, beside the sub-maps."""
    seeds = seeds[: FLOOR.seeds]
    drives, submaps = [driven(FLOOR, seed) for seed in seeds], [in_submaps(FLOOR, seed) for seed in seeds]
    single = [in_one_map(FLOOR, seed) for seed in seeds]
    ratios = [one.worst_m / ours.worst_m for one, ours in zip(single, submaps, strict=True)]
    figure, panels = plt.subplots(1, 2, figsize=(7.2, 3.4), dpi=80)
    for panel, title, one in zip(panels, ("one map", "sub-maps"), (single[0], submaps[0]), strict=True):
        scans = [frame for frame in drives[0].frames if isinstance(frame, LaserScan)]
        points = [
            end_points(scan, one.poses[scan.stamp_ns] @ FORWARD)
            for scan in scans[::5]
            if scan.stamp_ns in one.poses
        ]
        panel.plot(*np.concatenate(points)[::3].T, "k,", alpha=0.15)
        panel.set_title(title, fontsize=8)
        panel.set_aspect("equal")
        panel.tick_params(labelsize=7)
        draw_scale(panel, 10.0)
    caption = f"A floor, seed {seeds[0]}: end points of every fifth scan at its estimated pose"
    return Section(
        "One map or many",
        "The same drives round the floors of 2000 m2 with as many particles, as one map without loop "
        "closing: later scans are matched to its errors.",
        [
            Row("one map: worst check point", worst(single), "m", "D18"),
            Row(
                "so many times that of the sub-maps",
                ratios,
                "times",
                "D18",
                at_least=3.0,
                by_worst=True,
                digits=1,
                cause=SHORT,
            ),
            Row("one map: CPU a scan", [one.scan_ms for one in single], "ms"),
        ],
        pictures=[save(figure, "submap-graph-floor.png", caption)],
        ran_on=seeds_text(seeds),
    )


def memory(seeds: Sequence[int]) -> Section:
    """D8: lap after lap round the office, without new walls."""
    ride = driven(LAPS, seeds[0])
    mapper, back_ends = mapper_and_back_ends()
    lap_s = office().drive.duration_s
    tiles, kept_mb, path_length_m, walls_mb = [0] * LAP_COUNT, [0.0] * LAP_COUNT, [0.0] * LAP_COUNT, 0.0
    for frame in ride.frames:
        if mapper.process(frame) is None:
            continue
        lap = min(int(frame.stamp_ns * 1e-9 / lap_s), LAP_COUNT - 1)
        tiles[lap] = max(tiles[lap], mapper.components.local_map.tile_count)
        while mapper.graph.waiting:
            mapper.apply_result()
            kept, walls = (len(pickle.dumps(one)) for one in (back_ends[0], back_ends[0].walls))
            kept_mb[lap], walls_mb, path_length_m[lap] = (
                (kept - walls) / 1e6,
                walls / 1e6,
                back_ends[0].path_length_m[-1],
            )
    grown_mb, driven_m = kept_mb[-1] - kept_mb[1], path_length_m[-1] - path_length_m[1]
    ratio = tiles[-1] / tiles[1]
    return Section(
        "Memory, lap after lap",
        f"{LAP_COUNT} laps of the office, without new walls after the first. Tiles are the "
        "maximum in a lap, of all particles together. The memory of the graph is its size when it is sent "
        "to another process: the scans of all closed sub-maps, to compare them and to draw the shown map "
        "again, in steps of 1 mm and 0.1 mrad; and beside it, once, the walls of the 8 sub-maps compared "
        "last.",
        [
            Row("tiles of the particles: last lap by second", [ratio], "times", "D8", at_most=1.1),
            Row(
                "the graph keeps for 100 m of path, second lap to last",
                [100.0 * grown_mb / driven_m],
                "MB",
                "D8",
                digits=2,
            ),
            Row("walls of the 8 sub-maps, whatever the path", [walls_mb], "MB", "D8", digits=1),
            Row(
                "both for two hours at 1 m/s, by this",
                [7200.0 * grown_mb / driven_m + walls_mb],
                "MB",
                "D8",
                at_most=50.0,
                cause=KEEPS,
            ),
        ],
        ran_on=seeds_text(seeds[:1]),
    )


def hours(seeds: Sequence[int]) -> Section:
    """D8: two hours in a process of its own; half an hour of a core."""
    command = [sys.executable, "-m", "tests.papers.submap_hours", str(seeds[0])]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE)
    return hours_reported(json.loads(done.stdout), seeds[0])


def hours_reported(found: Mapping[str, Any], seed: int) -> Section:
    """found: output of the process, for each ten minutes and for the graph at the end"""
    first, last = found["hours"][0], found["hours"][-1]
    lines = ["| minutes | path length | sub-maps | resident memory | pose off by |", "|---|---|---|---|---|"]
    lines += [
        f"| {one['minutes']:.0f} | {one['path_m']:.0f} m | {one['submaps']} | {one['resident_mb']:.0f} MB "
        f"| {100.0 * one['off_m']:.1f} cm |"
        for one in found["hours"]
    ]
    return Section(
        "Two hours",
        f"The floor of 2000 m2 again and again, {last['minutes']:.0f} minutes at 5 sweeps a second, 30 "
        "particles, mapping and graph in one process. Resident memory is what the process has grown by since "
        "before the first scan: particles, shown map, graph, and what a solve of the graph needs, 27 MB for "
        "2000 track points, which the C library does not give back.",
        [
            Row("the graph keeps", [found["graph_mb"]], "MB", "D8", at_most=50.0),
            Row("resident memory after ten minutes", [first["resident_mb"]], "MB", "D8"),
            Row("resident memory at the end", [last["resident_mb"]], "MB", "D8"),
        ],
        ["\n".join(lines)],
        ran_on=seeds_text([seed]),
    )


def worst(found: Sequence[Mapped]) -> list[float]:
    return [one.worst_m for one in found]


def distances(found: Sequence[Mapped]) -> list[float]:
    return [one.distance_m for one in found]


def run(
    what: Drive, settings: Mapping[str, Mapping[str, object]] | None = None, graph: bool = True
) -> Mapped:
    section = {"profile": "submap_graph", "settings": settings or {}}
    if not graph:
        section["components"] = {"graph": "no_graph"}
    mapper = build_mapper(mapping_config(section), {"front": FORWARD})
    outputs, began_s = [], time.thread_time()
    for frame in what.frames:
        output = mapper.process(frame)
        if output is not None:
            outputs.append(output)
            while mapper.graph.waiting:
                mapper.apply_result()
    poses = corrected(outputs, mapper.finish().corrections)
    took_s = time.thread_time() - began_s
    by_stamp = {output.stamp_ns: pose for output, pose in zip(outputs, poses, strict=True)}
    found, truth = check_points(what, by_stamp)
    return Mapped(
        float(np.hypot(*(points_from(align(found, truth), found) - truth).T).max()),
        float(np.abs(between_all(found) - between_all(truth)).max()),
        1000.0 * took_s / len(outputs),
        by_stamp,
    )


def check_points(what: Drive, poses: Mapping[int, SE2]) -> tuple[np.ndarray, np.ndarray]:
    """(CHECK_POINTS, 2) m each: where the map has places on walls, and where they are.

    A place is where end points of SEEN scans lie, each taken where its beam truly ended; the map has it where
    the median of those scans put it.
    """
    scans = [scan for scan in what.frames if isinstance(scan, LaserScan) and scan.stamp_ns in poses][::EVERY]
    near = [replace(scan, range_m=np.where(scan.range_m < NEAR_M, scan.range_m, np.nan)) for scan in scans]
    truth_of = [end_points(scan, what.truth[scan.stamp_ns] @ FORWARD) for scan in near]
    truth = np.concatenate(truth_of)
    moved = np.concatenate([end_points(scan, poses[scan.stamp_ns] @ FORWARD) for scan in near]) - truth
    scan_of = np.repeat(np.arange(len(scans)), [len(xy) for xy in truth_of])
    cell, cell_of = np.unique(np.floor(truth / BESIDE_M).astype(int), axis=0, return_inverse=True)
    seen = np.unique(np.stack([cell_of.ravel(), scan_of]), axis=1)[0]
    places = (cell[np.bincount(seen, minlength=len(cell)) >= SEEN] + 0.5) * BESIDE_M
    chosen, nearest_m = [0], np.hypot(*(places - places[0]).T)
    while len(chosen) < CHECK_POINTS:
        chosen.append(int(np.argmax(nearest_m)))
        nearest_m = np.minimum(nearest_m, np.hypot(*(places - places[chosen[-1]]).T))
    found = []
    for place in places[chosen]:
        beside = np.hypot(*(truth - place).T) < BESIDE_M
        of_scans = [moved[beside & (scan_of == scan)].mean(axis=0) for scan in np.unique(scan_of[beside])]
        found.append(place + np.median(of_scans, axis=0))
    return np.array(found), places[chosen]


def between_all(xy: np.ndarray) -> np.ndarray:
    distances_m: np.ndarray = np.hypot(*(xy[:, None] - xy[None]).transpose(2, 0, 1))
    return distances_m


SCENARIOS = {
    "office": lambda seeds: precision(OFFICE, seeds),
    "floor": lambda seeds: precision(FLOOR, seeds),
    "mall": lambda seeds: precision(MALL, seeds),
    "one_map": against_single,
    "weights": weights,
    "memory": memory,
    "hours": hours,
}
