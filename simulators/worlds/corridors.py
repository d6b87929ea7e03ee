"""Corridors, where a scan hardly constrains the position along."""

import math

from service.geometry.se2 import SE2
from simulators.trajectory import Follow, Limits, Pause, Spin, plan_drive
from simulators.world import Plan, World, make_world


def ring() -> World:
    """A ring of 30 x 20 m along its middle, 2 m wide, driven at 1.2 m/s with corners at about 70 deg/s."""
    plan = Plan()
    outer = [(-1.0, -1.0), (31.0, -1.0), (31.0, 21.0), (-1.0, 21.0)]
    inner = [(1.0, 1.0), (29.0, 1.0), (29.0, 19.0), (1.0, 19.0)]
    outer_doors = [(3.0, 9.4, 17.1, 26.0), (4.0, 12.3, 17.5), (2.2, 11.0, 15.7, 24.8), (6.1, 13.9)]
    inner_doors = [(5.2, 14.0, 22.3), (3.3, 12.9), (6.6, 13.1, 21.0), (8.2,)]
    for k in range(4):
        plan.sunk_doors(outer[k], outer[(k + 1) % 4], outer_doors[k], depth=-0.25)
        plan.sunk_doors(inner[k], inner[(k + 1) % 4], inner_doors[k], depth=0.25)
    limits = Limits(speed_mps=1.2, lateral_mps2=2.0, turn_rate_radps=math.radians(90.0))
    lap = Follow([(30, 0), (30, 20), (0, 20), (0, 0), (5, 0)], corner_radius_m=0.9)
    return make_world(
        "ring", plan, [], plan_drive(SE2(5.0, 0.0, 0.0), [lap, Pause(1.0)], limits, repeats=True)
    )


def corridor100(door_depth_m: float = 0.2) -> World:
    """A straight corridor of 100 x 2 m with sunk doors on both sides, driven out and back."""
    plan = Plan()
    south = [2.4 + 5.3 * k + 0.7 * math.sin(3.0 * k) for k in range(18)]
    north = [4.1 + 6.1 * k + 0.9 * math.sin(2.0 * k + 1.0) for k in range(16)]
    plan.sunk_doors((0, -1), (100, -1), south, depth=-door_depth_m)
    plan.sunk_doors((0, 1), (100, 1), north, depth=door_depth_m)
    plan.line((0, -1), (0, 1))
    plan.line((100, -1), (100, 1))
    drive = plan_drive(
        SE2(1.5, 0.0, 0.0),
        [Follow([(98.5, 0)]), Spin(math.pi), Follow([(1.5, 0)]), Spin(-math.pi), Pause(1.0)],
        repeats=True,
    )
    return make_world("corridor100", plan, [], drive)
