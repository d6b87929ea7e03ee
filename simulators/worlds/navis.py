"""The places of Tang et al. 2014: a T-shaped room, a corridor that ends in glass, halls of 100 m and more."""

import math

import numpy as np

from service.geometry.se2 import SE2
from simulators.trajectory import Follow, Leg, Limits, Pause, Spin, Trajectory, plan_drive
from simulators.world import Plan, World, make_world

SLOW = Limits(speed_mps=0.28, acceleration_mps2=1.0)


def _to_and_fro(begin: tuple[float, float], end: tuple[float, float], limits: Limits) -> Trajectory:
    legs: list[Leg] = [Follow([end]), Spin(math.pi), Follow([begin]), Spin(-math.pi), Pause(1.0)]
    return plan_drive(SE2(*begin, 0.0), legs, limits, repeats=True)


def t_room() -> World:
    """15 x 7 m over all, both arms 2 m wide (the paper leaves that open). Driven 14 m along the bar."""
    plan = Plan()
    plan.line(
        (0.0, 0.0), (0.0, -2.0), (6.5, -2.0), (6.5, -7.0), (8.5, -7.0), (8.5, -2.0), (15.0, -2.0),
        (15.0, 0.0), (0.0, 0.0),
    )  # fmt: skip
    return make_world("t_room", plan, [], _to_and_fro((0.5, -1.0), (14.5, -1.0), SLOW))


def glass_corridor() -> World:
    """A corridor of 41 x 2.2 m with doors and radiators. Its end is a glass wall with frames, before it glass
    handrails and plants; behind the glass stands what is outdoors. Driven 38.5 m towards the glass.
    """
    plan = Plan()
    plan.sunk_doors((0.0, -1.1), (37.0, -1.1), [1.6, 6.2, 9.1, 14.8, 19.9, 23.4, 28.7, 33.1], depth=-0.15)
    plan.sunk_doors((0.0, 1.1), (37.0, 1.1), [3.3, 7.4, 12.2, 16.1, 21.5, 26.0, 31.4], depth=0.15)
    plan.line((0.0, -1.1), (0.0, 1.1))
    for x, y in (
        (4.9, 1.02),
        (11.2, -1.02),
        (18.4, 1.02),
        (25.1, -1.02),
        (30.0, 1.02),
    ):  # radiators, cabinets
        plan.box((x, y), (1.0, 0.16), reflectivity=0.7)
    for side in (-1.1, 1.1):  # glass handrails on posts
        for k in range(4):
            plan.post((37.3 + k, side), 0.03, reflectivity=0.6)
            plan.line((37.3 + k, side), (38.3 + k, side), glass=True)
    for y in (-1.6, -0.55, 0.5, 1.55):  # the opaque frame of the glass wall
        plan.box((41.0, y), (0.08, 0.10), reflectivity=0.7)
    plan.line((41.0, -1.6), (41.0, 1.6), glass=True)
    plan.line((37.0, -1.1), (37.0, -1.9), (41.0, -1.9))
    plan.line((37.0, 1.1), (37.0, 1.9), (41.0, 1.9))
    for x, y, radius in ((37.9, -1.5, 0.18), (39.2, 1.5, 0.22), (40.3, -1.5, 0.15), (40.5, 1.2, 0.12)):
        plan.post((x, y), radius, reflectivity=0.3)
        for leaf in range(5):  # of the plant in the pot
            turn = 1.3 * leaf + x
            at = (x + 0.28 * math.cos(turn), y + 0.28 * math.sin(turn))
            plan.box(at, (0.18, 0.02), math.degrees(turn), reflectivity=0.3)
    for x, y in ((44.0, -2.0), (46.0, 1.5), (49.0, -0.5)):
        plan.post((x, y), 0.3, reflectivity=0.3)
    return make_world("glass_corridor", plan, [], _to_and_fro((1.0, 0.0), (39.5, 0.0), SLOW))


def hall(side_m: float) -> World:
    """A square hall, a pillar every 8 m, crates between. Driven from the middle towards its east wall."""
    plan = Plan()
    half = side_m / 2
    corners = [(-half, -half), (half, -half), (half, half), (-half, half)]
    for k in range(4):
        plan.line(corners[k], corners[(k + 1) % 4])
    noise = np.random.default_rng(7)
    count = int(half // 8)
    for row in range(-count, count + 1):
        for column in range(-count, count + 1):
            x, y = 8.0 * column + 4.0, 8.0 * row + 4.0
            if max(abs(x), abs(y)) < half - 1.0:
                plan.box((x, y), (0.6, 0.6), reflectivity=0.6)
                dx, dy, turn_deg = noise.uniform((-2.0, -1.5, 0.0), (2.0, 1.5, 90.0)).tolist()
                plan.box((x + dx, y + 2.0 + dy / 3), (1.2, 0.8), turn_deg, reflectivity=0.5)
    return make_world(
        f"hall{side_m:.0f}", plan, [], _to_and_fro((0.0, 0.0), (half - 4.0, 0.0), Limits(speed_mps=1.0))
    )
