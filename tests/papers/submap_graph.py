"""Paper 004: one precision in worlds of 300, 2000 and 12 000 m2; a single map beside. It has no figures."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from drivers.frames import LaserScan
from service.geometry.se2 import SE2
from service.mapper.background import InlineWorker
from service.mapper.corrections import corrected
from service.mapper.profiles import build_mapper, mapping_config
from simulators.world import World
from simulators.worlds.floor import floor
from simulators.worlds.mall import mall
from simulators.worlds.office import office
from tests.papers.pictures import draw_scale, end_points, plt, save
from tests.papers.report import Row, Section, told
from tests.simulated import FORWARD, LMS100_50HZ, Drive, Laser, Wheels, drive

CHECK_POINTS = 20
CART = Laser(LMS100_50HZ.model, 541, 5.0, -135.0, 0.5)  # every tenth sweep


@dataclass(frozen=True)
class Place:
    name: str
    area_m2: int
    world: Callable[[], World]
    seconds: float
    seeds: int  # at most so many: the largest takes minutes each
    particles: int = 10


PLACES = (
    Place("office", 300, office, 60.0, 5),
    Place("floor", 2000, floor, 260.0, 2),
    Place("mall", 12_000, mall, 1250.0, 1, particles=3),
)


@dataclass(frozen=True)
class Mapped:
    """Of the check points: greatest error after a rigid fit, that of distances between them; cost."""

    worst_m: float
    distance_m: float
    scan_ms: float
    poses: dict[int, SE2]  # by stamp, in the map


Outcomes = tuple[list[Drive], list[Mapped]]


@cache
def mapped(place: Place, seeds: Sequence[int]) -> Outcomes:
    driven = [
        drive(place.world(), CART, place.seconds, seed, Wheels(scale=1.01, turn_scale=1.01)) for seed in seeds
    ]
    return driven, [run(what, {"particles": place.particles}) for what in driven]


def precision(seeds: Sequence[int]) -> Section:
    """D19."""
    rows: list[Row] = []
    for place in PLACES:
        found = mapped(place, seeds[: place.seeds])[1]
        what = f"{place.name}, {place.area_m2} m2"
        rows += [
            Row(
                "D19", f"{what}: worst of {CHECK_POINTS} check points", worst(found), "m", 0.10, by_worst=True
            ),
            Row("D19", f"{what}: worst distance between two", distances(found), "m", 0.10, by_worst=True),
            Row("", f"{what}: CPU a scan", [one.scan_ms for one in found], "ms", digits=1),
        ]
    return Section(
        "One precision from 300 to 12 000 m2",
        "A cart with an LMS100 at 5 sweeps a second, wheels 1 % off, 10 particles; in the mall 3. "
        f"{CHECK_POINTS} key poses spread over the drive are compared with the truth after a rigid fit, "
        "and the distances between all of them without one. The mall is driven once, the floor twice: they "
        "take minutes.",
        rows,
    )


def against_single(seeds: Sequence[int]) -> Section:
    """D18, D20: the mall as one map that is never closed and never corrected, beside the sub-maps."""
    drives, submaps = mapped(PLACES[-1], seeds[: PLACES[-1].seeds])
    single = [run(what, {"particles": PLACES[-1].particles, "length_m": 1e6}, graph=False) for what in drives]
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
        draw_scale(panel, 50.0)
    caption = "The mall: end points of every fifth scan laid where the scan was mapped"
    return Section(
        "One map or many",
        "The same drive through the mall and the same particles, as one map that is never closed: what it "
        "drew wrong it is laid on again.",
        [
            Row("D18", "mall, one map: worst check point", worst(single), "m"),
            Row("D18", "so many times that of the sub-maps", ratios, "times", at_least=3.0, digits=1),
            Row("", "mall, one map: CPU a scan", [one.scan_ms for one in single], "ms", digits=1),
        ],
        pictures=[save(figure, "submap-graph-mall.png", caption)],
        ran_on=told(seeds[: PLACES[-1].seeds]),
    )


def worst(found: Sequence[Mapped]) -> list[float]:
    return [one.worst_m for one in found]


def distances(found: Sequence[Mapped]) -> list[float]:
    return [one.distance_m for one in found]


def run(what: Drive, local_map: dict[str, float], graph: bool = True) -> Mapped:
    section = {"profile": "submap_graph", "settings": {"local_map": local_map}}
    if not graph:
        section["stages"] = {"graph": "no_graph"}
    mapper = build_mapper(mapping_config(section), {"front": FORWARD}, new_worker=InlineWorker)
    outputs, began_s = [], time.thread_time()
    for frame in what.frames:
        output = mapper.process(frame)
        if output is not None:
            outputs.append(output)
            while mapper.graph.waiting:
                mapper.apply_result()
    poses = corrected(outputs, mapper.finish().corrections)
    took_s = time.thread_time() - began_s
    at = np.linspace(0, len(outputs) - 1, CHECK_POINTS).astype(int)
    found = places([poses[k] for k in at])
    truth = places([what.truth[outputs[k].stamp_ns] for k in at])
    return Mapped(
        float(np.hypot(*(fitted(found, truth) - truth).T).max()),
        float(np.abs(between_all(found) - between_all(truth)).max()),
        1000.0 * took_s / len(outputs),
        {output.stamp_ns: pose for output, pose in zip(outputs, poses, strict=True)},
    )


def places(poses: Sequence[SE2]) -> np.ndarray:
    return np.array([(pose.x_m, pose.y_m) for pose in poses])


def between_all(xy: np.ndarray) -> np.ndarray:
    distances_m: np.ndarray = np.hypot(*(xy[:, None] - xy[None]).transpose(2, 0, 1))
    return distances_m


def fitted(xy: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Turned and moved, never stretched, to lie best on the truth."""
    a, b = xy - xy.mean(axis=0), truth - truth.mean(axis=0)
    turn = np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum())
    c, s = np.cos(turn), np.sin(turn)
    laid: np.ndarray = a @ np.array([[c, s], [-s, c]]) + truth.mean(axis=0)
    return laid


SCENARIOS = {"precision": precision, "one_map": against_single}
