"""Drives of 500 m, each by a route of its own, through the aisles of a mall of 20 000 m2."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from service.geometry.se2 import SE2
from simulators.trajectory import Follow, Limits, Trajectory, plan_drive
from simulators.truth import noise_of
from simulators.world import Point, World, make_world
from simulators.worlds.mall import AISLES_X, AISLES_Y, SEED, mall_plan
from tests.bench.site_drives import record_beside_truth
from tests.simulated import LMS100_50HZ, Wheels, begun_beside, drive, phase_m

DRIVE_M = 500.0
LANES_X = (*AISLES_X, 143.0, 170.0, 195.0)  # 200 m by 100 m
LIMITS = Limits(speed_mps=2.0, lateral_mps2=0.8)
LASER = replace(LMS100_50HZ, beams=271, rate_hz=25.0, step_deg=1.0, every=8)  # 3.1 scans a second
DIRECTIONS = ((1, 0), (0, 1), (-1, 0), (0, -1))


def record_drive(seed: int, folder: Path) -> tuple[Path, Path, float]:
    """site_SEED.mcap, beside it the true poses in the frame of the site as a TUM file, and its length, m."""
    planned = random_drive(seed)
    world = begun_beside(site_of(planned), *phase_m(seed))
    made = drive(world, LASER, planned.duration_s, seed, Wheels())
    start = planned.start
    first = SE2(start.x_m, start.y_m, start.theta_rad) @ made.world_first
    return *record_beside_truth(made, first, seed, folder), planned.length_m


def site_of(planned: Trajectory) -> World:
    return make_world("site", mall_plan(np.random.default_rng(SEED), LANES_X), (), planned)


def random_drive(seed: int) -> Trajectory:
    """From a crossing of aisles to the next ones, straight on or round a corner, DRIVE_M or somewhat more."""
    noise = noise_of(seed, "route", 0)
    column, row = int(noise.integers(len(LANES_X))), int(noise.integers(len(AISLES_Y)))
    points: list[Point] = [(LANES_X[column], AISLES_Y[row])]
    direction, length_m = None, 0.0
    while length_m < DRIVE_M:
        possible = [
            (i, j)
            for i, j in DIRECTIONS
            if 0 <= column + i < len(LANES_X)
            and 0 <= row + j < len(AISLES_Y)
            and (direction is None or (-i, -j) != direction)
        ]
        i, j = possible[int(noise.integers(len(possible)))]
        column, row = column + i, row + j
        point = LANES_X[column], AISLES_Y[row]
        length_m += abs(point[0] - points[-1][0]) + abs(point[1] - points[-1][1])
        if direction == (i, j):
            points.pop()
        points.append(point)
        direction = i, j
    (x_m, y_m), (next_x_m, next_y_m) = points[:2]
    start = SE2(x_m, y_m, float(np.arctan2(next_y_m - y_m, next_x_m - x_m)))
    return plan_drive(start, [Follow(points[1:], corner_radius_m=1.5)], LIMITS)
