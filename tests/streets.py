"""Streets round a block of 600 x 400 m: a lap of 2 km between house fronts, gates, trees and parked cars."""

import math

import numpy as np

from service.geometry.se2 import SE2
from simulators.trajectory import Follow, Leg, Limits, Pause, plan_drive
from simulators.world import Plan, Point, World, make_world

LENGTH_M, WIDTH_M = 600.0, 400.0  # of the middle line of the lap
HALF_M = 9.0  # from there to the fronts
OVERLAP_M = 20.0  # of the lap that are driven again
HOUSE_M = (12.0, 30.0)  # length of a front
DEPTH_M = 3.0  # fronts stand back by up to so much
GATE_M = (3.0, 14.0)  # between two houses
START = SE2(LENGTH_M / 2.0, 0.0, 0.0)
CORNERS = ((0.0, 0.0), (LENGTH_M, 0.0), (LENGTH_M, WIDTH_M), (0.0, WIDTH_M))
SEED = 2000


def streets() -> World:
    """A lap takes about 7 min at 5 m/s. The drive does not repeat."""
    rng = np.random.default_rng(SEED)
    plan = Plan()
    for k in range(4):
        begin, end = CORNERS[k], CORNERS[(k + 1) % 4]
        _draw_side(plan, rng, begin, end, outward=-1.0)
        _draw_side(plan, rng, begin, end, outward=1.0)
    path: list[Point] = [*CORNERS[1:], CORNERS[0], (START.x_m + OVERLAP_M, 0.0)]
    limits = Limits(speed_mps=5.0, acceleration_mps2=1.0, lateral_mps2=1.5)
    legs: list[Leg] = [Follow(path, corner_radius_m=8.0), Pause(1.0)]
    return make_world("streets", plan, [], plan_drive(START, legs, limits))


def _draw_side(plan: Plan, rng: np.random.Generator, begin: Point, end: Point, outward: float) -> None:
    """Houses, trees and cars along one side of a street; outward: -1 outside of the lap, 1 inside."""
    length_m = math.dist(begin, end)
    ahead = ((end[0] - begin[0]) / length_m, (end[1] - begin[1]) / length_m)
    turn_deg = math.degrees(math.atan2(ahead[1], ahead[0]))

    def at(along_m: float, aside_m: float) -> Point:
        return (
            begin[0] + ahead[0] * along_m - ahead[1] * aside_m,
            begin[1] + ahead[1] * along_m + ahead[0] * aside_m,
        )

    first_m, last_m = (-HALF_M, length_m + HALF_M) if outward < 0.0 else (HALF_M, length_m - HALF_M)
    along_m = first_m
    while along_m < last_m:
        house_m = min(float(rng.uniform(*HOUSE_M)), last_m - along_m)
        front_m = outward * (HALF_M + float(rng.uniform(0.0, DEPTH_M)))
        back_m = outward * (HALF_M + DEPTH_M + 4.0)
        outline = [
            (along_m, back_m),
            (along_m, front_m),
            (along_m + house_m, front_m),
            (along_m + house_m, back_m),
        ]
        plan.line(*(at(*corner) for corner in outline), reflectivity=0.5)
        along_m += house_m + float(rng.uniform(*GATE_M))
    for along_m in np.arange(first_m + 12.0, last_m - 12.0, 15.0).tolist():
        if rng.random() < 0.7:
            plan.post(at(along_m + float(rng.uniform(-3.0, 3.0)), outward * (HALF_M - 2.0)), 0.2, 0.3)
        if rng.random() < 0.5:
            car = at(along_m + float(rng.uniform(3.0, 6.0)), outward * (HALF_M - 3.5))
            plan.box(car, (4.3, 1.8), turn_deg, 0.4)
