"""A library of 45 x 30 m: bookcases in rows, a long glass cabinet, tables and chairs, a lap of 116 m.

+------------------------------------------+
| t    <--------------------------     t   |
| t  |  B    B    B    B    B    B  |  t   |
|    |  +------------------------+  ^      |
|    v  |   offices              |  |      |
|    |  +------------------------+  |      |
| t  |  B    B    B    B    B    B  |  t   |
| t    start ----------------------'   t   |
|      ====== glass cabinet ======         |
+------------------------------------------+
"""

import math

import numpy as np

from service.geometry.se2 import SE2
from simulators.trajectory import Follow, Leg, Limits, Pause, Spin, plan_drive
from simulators.world import Plan, Point, World, make_world

START_M = (6.0, 4.0)
LAP = [(41.0, 4.0), (41.0, 26.0), (4.0, 26.0), (4.0, 4.0), START_M]
WIDTH_M, HEIGHT_M = 45.0, 30.0
CASE_X_M = (10.0, 14.0, 18.0, 22.0, 26.0, 30.0)
CASE_Y_M = ((6.5, 11.0), (19.0, 23.5))  # ends of the bookcases, south and north of the offices
CASE_WIDTH_M = 0.8
BOOK_DEPTH_M = 0.15  # books stand up to so far behind the front of their case
BOOK_ROW_M = (0.08, 0.35)  # length of a row of books of one size
OFFICES_M = (9.0, 13.0, 33.0, 17.0)  # x and y of two opposite corners
CABINET_M = (8.0, 34.0, 1.6)  # from x to x, and y of the glass
SCREEN_M = 2.0  # length of the screens that stand out from the outer walls
SCREENS_M = ((0.0, 9.0), (0.0, 20.0), (WIDTH_M, 12.0), (WIDTH_M, 21.0))


def library(heading_deg: float = 0.0) -> World:
    """A lap takes about 90 s. heading_deg: of the vehicle at its start, from the long walls."""
    plan = Plan()
    draw_structure(plan)
    noise = np.random.default_rng(12)
    for x in CASE_X_M:
        for ends in CASE_Y_M:
            for side in (-1.0, 1.0):
                _draw_books(plan, x + side * CASE_WIDTH_M / 2, -side, ends, noise)
    west, east, y = CABINET_M
    plan.line((west, y), (east, y), cabinet=True, reflectivity=0.5)
    limits = Limits(speed_mps=1.4, acceleration_mps2=0.8, lateral_mps2=1.0, turn_rate_radps=1.0)
    heading_rad = math.radians(heading_deg)
    legs: list[Leg] = [Follow(LAP, corner_radius_m=1.0), Spin(heading_rad), Pause(1.0)]
    return make_world("library", plan, [], plan_drive(SE2(*START_M, heading_rad), legs, limits, repeats=True))


def draw_structure(plan: Plan) -> None:
    """All but books and glass."""
    plan.line((0, 0), (WIDTH_M, 0), (WIDTH_M, HEIGHT_M), (0, HEIGHT_M), (0, 0))
    west, south, east, north = OFFICES_M
    plan.line((west, south), (east, south), (east, north), (west, north), (west, south))
    for x in CASE_X_M:
        for ends in CASE_Y_M:
            for y in ends:  # end panels
                plan.line((x - CASE_WIDTH_M / 2, y), (x + CASE_WIDTH_M / 2, y), reflectivity=0.5)
    west, east, y = CABINET_M
    for x in (west, east):
        plan.line((x, 0.0), (x, y), reflectivity=0.5)
    for x, y in SCREENS_M:
        inward = SCREEN_M if x == 0.0 else -SCREEN_M
        plan.box((x + inward / 2, y), (SCREEN_M, 0.06), reflectivity=0.5)
    for y in (5.5, 12.5, 16.5, 24.0):
        for x in (1.6, 43.4):
            plan.table((x, y), (1.0, 2.0))
            for k in range(4):
                turned = 37.0 * k + 11.0 * y
                _chair(plan, (x + 0.75 * (-1) ** k, y - 0.6 + 0.4 * k), turned)


def _draw_books(
    plan: Plan, front_x: float, inward: float, ends: tuple[float, float], noise: np.random.Generator
) -> None:
    """One side of a bookcase along y: rows of books at random depth behind the front, no gap between them."""
    at = ends[0]
    depth = noise.uniform(0.0, BOOK_DEPTH_M)
    points: list[Point] = [(front_x, at), (front_x + inward * depth, at)]
    while at < ends[1]:
        at = min(at + noise.uniform(*BOOK_ROW_M), ends[1])
        points.append((front_x + inward * depth, at))
        depth = noise.uniform(0.0, BOOK_DEPTH_M)
        points.append((front_x + inward * depth, at))
    points.append((front_x, ends[1]))
    plan.line(*points, reflectivity=0.4)


def _chair(plan: Plan, centre: Point, turn_deg: float) -> None:
    """A chair's four legs."""
    c, s = math.cos(math.radians(turn_deg)), math.sin(math.radians(turn_deg))
    for u, v in ((-0.2, -0.2), (0.2, -0.2), (0.2, 0.2), (-0.2, 0.2)):
        plan.box((centre[0] + c * u - s * v, centre[1] + s * u + c * v), (0.03, 0.03), turn_deg, 0.3)
