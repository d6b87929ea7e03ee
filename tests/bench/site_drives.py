"""Drives of one simulated site, parts of a lap from several starts, in both directions: a ring of corridors,
an office and a mall that passages join.
"""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from service.geometry import poses as se2
from service.geometry.se2 import SE2
from service.offline.score.trajectory import write_tum
from simulators.trajectory import PATH_LENGTH, THETA, TURN_RATE, Floats, Follow, Limits, Pause, plan_drive
from simulators.world import Plan, Point, World, make_world
from simulators.worlds.corridors import ring
from simulators.worlds.floor import floor
from simulators.worlds.mall import mall
from simulators.worlds.office import START, office
from tests.recorded_drive import record
from tests.service.recording.sessions import T0_NS
from tests.simulated import FORWARD, LMS100_50HZ, Drive, Wheels, begun_beside, drive, phase_m

SEEDS = range(11, 23)
ELSEWHERE = (21, 22)  # of another building
SECONDS, APART_S = 130.0, 31.0  # of each drive, and between their starts along the lap
HOUR_NS = 3600 * 10**9
PARTS = {  # each with the pose of its start, and where the corner of its plan lies in the site, m
    ring: (SE2(5.0, 0.0, 0.0), (-39.0, 36.0)),
    office: (START, (-32.0, 9.2)),
    mall: (SE2(10.0, 5.0, 0.0), (0.0, 0.0)),
}
PASSAGES_M = {16.0: (-9.0, 0.4), 46.0: (-8.5, 0.4)}  # at y, from x to x: walls there are removed
HALF_PASSAGE_M = 1.2
LAP = [
    *[(5, 16), (5, 35), (32, 35), (32, 65), (5, 65), (5, 46)],
    *[(-9, 46), (-9, 56), (-39, 56), (-39, 36), (-9, 36), (-9, 46), (5, 46), (5, 16)],
    *[(-11, 16), (-11, 13.3), (-29.2, 13.3), (-29.2, 18.1), (-11, 18.1), (-11, 16), (-4, 16)],
]
LASER = replace(LMS100_50HZ, rate_hz=25.0)


def record_drive(seed: int, folder: Path) -> tuple[Path, Path]:
    """site_SEED.mcap, and beside it the true poses in the frame of the world as a TUM file."""
    world = floor() if seed in ELSEWHERE else site()
    world = begun_beside(backwards(world) if seed % 2 == 0 else world, *phase_m(seed))
    made = drive(world, LASER, SECONDS, seed, Wheels(), stand_s=-(seed - SEEDS[0]) * APART_S)
    return record_beside_truth(made, made.world_first, seed, folder)


def record_beside_truth(made: Drive, first: SE2, seed: int, folder: Path) -> tuple[Path, Path]:
    """first: pose of the first scan in the frame of the poses written"""
    begin_ns = T0_NS + seed * HOUR_NS
    session = record(made.frames, {"front": FORWARD}, folder / "in" / str(seed), begin_ns)
    session = session.rename(folder / f"site_{seed}.mcap")
    truth = folder / f"site_{seed}.tum"
    write_tum(truth, ((stamp_ns + begin_ns, first @ pose) for stamp_ns, pose in sorted(made.truth.items())))
    return session, truth


def site() -> World:
    """12 000 m2; a lap of 350 m."""
    plan = Plan()
    for world, (start, (x_m, y_m)) in ((make(), place) for make, place in PARTS.items()):
        corner = np.array([start.x_m + x_m, start.y_m + y_m, start.theta_rad])
        ends = se2.points_from(corner, world.segments.reshape(-1, 2)).reshape(-1, 2, 2)
        for (first, last), light in zip(ends, world.reflectivity.tolist(), strict=True):
            for begin, end in outside_passages(first, last):
                plan.line(begin, end, reflectivity=light)
    for y_m, (left_m, right_m) in PASSAGES_M.items():
        for side_m in (-HALF_PASSAGE_M, HALF_PASSAGE_M):
            plan.line((left_m + 1.0, y_m + side_m), (right_m - 0.4, y_m + side_m))
    legs = [Follow(LAP, corner_radius_m=0.8), Pause(1.0)]
    limits = Limits(speed_mps=1.2, lateral_mps2=0.8)
    return make_world("site", plan, [], plan_drive(SE2(-4.0, 16.0, 0.0), legs, limits, repeats=True))


def outside_passages(first: Floats, last: Floats) -> list[tuple[Point, Point]]:
    """The parts of a wall (2,) to (2,) that stand in no passage."""
    shares = {0.0, 1.0}
    along = last - first
    for y_m, (left_m, right_m) in PASSAGES_M.items():
        for axis, edges in ((0, (left_m, right_m)), (1, (y_m - HALF_PASSAGE_M, y_m + HALF_PASSAGE_M))):
            shares |= {(edge - first[axis]) / along[axis] for edge in edges if along[axis]}
    kept = []
    for low, high in pairwise(sorted(share for share in shares if 0.0 <= share <= 1.0)):
        x_m, y_m = first + 0.5 * (low + high) * along
        if not any(
            left_m < x_m < right_m and abs(y_m - middle_m) < HALF_PASSAGE_M
            for middle_m, (left_m, right_m) in PASSAGES_M.items()
        ):
            begin, end = (first + share * along for share in (low, high))
            kept.append(((float(begin[0]), float(begin[1])), (float(end[0]), float(end[1]))))
    return kept


def backwards(world: World) -> World:
    """The same lap, driven from its end to its begin."""
    nodes = world.drive.nodes[::-1].copy()
    nodes[:, PATH_LENGTH] = nodes[0, PATH_LENGTH] - nodes[:, PATH_LENGTH]
    nodes[:, THETA] += np.pi
    nodes[:, TURN_RATE] *= -1.0
    return replace(world, drive=replace(world.drive, nodes=nodes))
