"""An office floor of 50 x 40 m: a ring of corridor round a core, rooms on both sides, many doors open."""

import numpy as np

from service.geometry.se2 import SE2
from simulators.trajectory import Follow, Leg, Limits, Pause, Spin, plan_drive
from simulators.world import Plan, World, make_world

SEED = 2000
WALKING = Limits(speed_mps=1.0, lateral_mps2=0.8)
OUTER, INNER = (8.0, 8.0, 42.0, 32.0), (10.4, 10.4, 39.6, 29.6)  # sides of the corridor, m


def floor(limits: Limits = WALKING, layout: int = SEED) -> World:
    """2000 m2; a lap of 115 m round the ring, and a passage through the core. Doors and furniture stand as
    the number of the layout gives.
    """
    rng = np.random.default_rng(layout)
    plan = Plan()
    plan.line((0.0, 0.0), (50.0, 0.0), (50.0, 40.0), (0.0, 40.0), (0.0, 0.0))
    left, low, right, high = OUTER
    corners = [(left, low), (right, low), (right, high), (left, high)]
    for k in range(4):
        begin, end = corners[k], corners[(k + 1) % 4]
        length = abs(end[0] - begin[0]) + abs(end[1] - begin[1])
        doors = np.arange(2.0, length - 2.0, 4.0) + rng.uniform(
            0.0, 2.0, len(np.arange(2.0, length - 2.0, 4.0))
        )
        plan.wall(begin, end, [(float(at), float(at) + 0.9) for at in doors])
    for x in np.arange(4.0, 50.0, 4.6):  # rooms along the long sides
        plan.wall((float(x), 0.0), (float(x), low))
        plan.wall((float(x), high), (float(x), 40.0))
    for y in np.arange(10.0, 31.0, 5.0):
        plan.wall((0.0, float(y)), (left, float(y)))
        plan.wall((right, float(y)), (50.0, float(y)))
    left, low, right, high = INNER
    for x0, x1 in ((left, 23.6), (26.0, right)):  # the core in two halves
        plan.wall((x0, low), (x1, low), [(3.0, 3.9), (9.0, 9.9)])
        plan.wall((x0, high), (x1, high), [(5.0, 5.9)])
        plan.wall((x0, low), (x0, high), [(8.0, 8.9)])
        plan.wall((x1, low), (x1, high), [(4.0, 4.9), (13.0, 13.9)])
    for _ in range(60):
        x, y = rng.uniform(1.0, 49.0), rng.choice([rng.uniform(1.0, 6.5), rng.uniform(33.5, 39.0)])
        plan.box((float(x), float(y)), (float(rng.uniform(0.4, 1.6)), 0.6), float(rng.choice([0.0, 90.0])))
    ring = [(40.8, 9.2), (40.8, 30.8), (9.2, 30.8), (9.2, 9.2)]
    through = [(24.8, 9.2), (24.8, 30.8), (40.8, 30.8), (40.8, 9.2), (10.2, 9.2)]
    legs: list[Leg] = [Follow([*ring, *through], corner_radius_m=0.8), Spin(np.pi), Pause(1.0)]
    drive = plan_drive(SE2(10.2, 9.2, 0.0), legs, limits, repeats=True)
    return make_world("floor", plan, (), drive)
