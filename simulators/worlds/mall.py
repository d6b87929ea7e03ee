"""A shopping mall of 120 x 100 m: five by four aisles, twelve blocks of shops, many people, many loops."""

import itertools
import math
from collections.abc import Sequence

import numpy as np

from service.geometry.se2 import SE2
from simulators.trajectory import Follow, Leg, Limits, Pause, Spin, plan_drive
from simulators.world import Plan, Walk, World, make_world, walk

AISLES_X = (5.0, 32.0, 60.0, 88.0, 115.0)
AISLES_Y = (5.0, 35.0, 65.0, 95.0)
HALF_WIDTH_M = 3.0
SHOP_M = 7.0  # about this wide
SEED = 12000
WALKING = Limits(speed_mps=1.2, lateral_mps2=0.8)

LAP = [
    *[(115, 5), (115, 35), (5, 35), (5, 65), (115, 65), (115, 95), (5, 95), (5, 5)],
    *[(32, 5), (32, 95), (60, 95), (60, 5), (88, 5), (88, 95), (115, 95), (115, 5), (10, 5)],
]


def mall(limits: Limits = WALKING) -> World:
    """12 000 m2; one lap is 1.2 km."""
    rng = np.random.default_rng(SEED)
    plan = mall_plan(rng)
    legs: list[Leg] = [Follow(LAP, corner_radius_m=1.5), Spin(math.pi), Pause(1.0)]
    drive = plan_drive(SE2(10.0, 5.0, 0.0), legs, limits, repeats=True)
    return make_world("mall", plan, _people(rng, drive.duration_s), drive)


def mall_plan(rng: np.random.Generator, aisles_x: Sequence[float] = AISLES_X) -> Plan:
    """Without people. aisles_x: middles of the aisles along y, rising, m; the first is AISLES_X[0]."""
    plan = Plan()
    width_m = aisles_x[0] + aisles_x[-1]
    corners = [(0.0, 0.0), (width_m, 0.0), (width_m, 100.0), (0.0, 100.0)]
    for k in range(4):
        doors = np.arange(4.0, 94.0, 9.0) + rng.uniform(0.0, 4.0, 10)
        plan.sunk_doors(corners[k], corners[(k + 1) % 4], doors.tolist(), depth=-0.4, width=1.8)
    for left, right in itertools.pairwise(aisles_x):
        for low, high in itertools.pairwise(AISLES_Y):
            sides = (left + HALF_WIDTH_M, low + HALF_WIDTH_M, right - HALF_WIDTH_M, high - HALF_WIDTH_M)
            _draw_block(plan, rng, *sides)
    _furnish_aisles(plan, rng, aisles_x)
    return plan


def _draw_block(
    plan: Plan, rng: np.random.Generator, left: float, low: float, right: float, high: float
) -> None:
    """Shops along the lower and the upper side, back to back."""
    middle = (low + high) / 2 + rng.uniform(-2.0, 2.0)
    plan.wall((left, middle), (right, middle))
    for x in (left, right):
        plan.wall((x, low), (x, high))
    for front in (low, high):
        count = round((right - left) / SHOP_M)
        sides = np.linspace(left, right, count + 1)
        gaps = []
        for begin, end in itertools.pairwise(sides):
            width = rng.uniform(1.5, 3.5)
            at = rng.uniform(begin + 0.8, end - 0.8 - width) - left
            gaps.append((at, at + width))
            _furnish_shop(plan, rng, begin, end, min(front, middle), max(front, middle))
        plan.wall((left, front), (right, front), gaps)
        for x in sides[1:-1]:
            plan.wall((x, front), (x, middle))


def _furnish_shop(
    plan: Plan, rng: np.random.Generator, left: float, right: float, low: float, high: float
) -> None:
    for _ in range(3):
        centre = (rng.uniform(left + 1.2, right - 1.2), rng.uniform(low + 2.0, high - 2.0))
        size = (rng.uniform(0.6, 2.0), rng.uniform(0.4, 0.8))
        plan.box(centre, size, float(rng.choice([0.0, 90.0, rng.uniform(0.0, 180.0)])), rng.uniform(0.2, 0.6))


def _furnish_aisles(plan: Plan, rng: np.random.Generator, aisles_x: Sequence[float]) -> None:
    """Columns in the corners of each crossing; benches and plants at the sides, off the lane."""
    for x, y in itertools.product(aisles_x, AISLES_Y):
        for u, v in itertools.product((-1, 1), (-1, 1)):
            plan.post((x + 2.4 * u, y + 2.4 * v), 0.25, 0.7)
    for y in AISLES_Y:
        for left, right in itertools.pairwise(aisles_x):
            for x in np.arange(left + 6.0, right - 5.0, 7.0):
                side = rng.choice([-2.3, 2.3])
                plan.box((x + rng.uniform(-1.0, 1.0), y + side), (1.6, 0.5), 0.0, 0.4)
    for x in aisles_x:
        for low, high in itertools.pairwise(AISLES_Y):
            for y in np.arange(low + 7.0, high - 6.0, 8.0):
                plan.post((x + rng.choice([-2.3, 2.3]), y + rng.uniform(-1.0, 1.0)), 0.35, 0.3)


def _people(rng: np.random.Generator, lap_s: float) -> list[Walk]:
    """Each keeps to one stretch between two crossings, beside the lane of the vehicle."""
    people = []
    for y in AISLES_Y:
        for left, right in itertools.pairwise(AISLES_X):
            beside = y + rng.choice([-1.3, 1.3])
            a, b = left + rng.uniform(4.0, 8.0), right - rng.uniform(4.0, 8.0)
            speed_mps = rng.uniform(0.7, 1.3)
            rounds = int(lap_s // (2 * (b - a) / speed_mps + 15.0))
            people.append(walk([(a, beside), (b, beside)], lap_s / rounds, speed_mps, rng.uniform(0.0, 6.0)))
    return people
