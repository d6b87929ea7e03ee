"""An office of 24 x 13 m: two large rooms joined by two arms of a ring corridor, six small rooms, people.

+------------+-------+-------+-------+------------+
|            |       |       |       |            |
|   open     +-- . --+-- . --+-- . --+  workshop  |
|   plan     <------------------------<--.        |
|     .---   |  +-----------------+  |   |        |
|     v      |  |    core         |  |   |        |
|     start  |  +-----------------+  |   |        |
|     '------>----------------------->---'        |
|            +-- . --+-- . --+-- . --+            |
|            |       |       |       |            |
+------------+-------+-------+-------+------------+
"""

import math

from service.geometry.se2 import SE2
from simulators.trajectory import Follow, Limits, Pause, plan_drive
from simulators.world import Plan, World, make_world, walk

START = SE2(2.8, 6.9, -math.pi / 2)
LAP = [(2.8, 4.1), (21.0, 4.1), (21.0, 8.9), (2.8, 8.9), (2.8, 6.9)]


def office() -> World:
    """About 310 m2; one lap is 46 m and takes just under a minute."""
    limits = Limits(speed_mps=1.0, acceleration_mps2=0.6, lateral_mps2=0.7, turn_rate_radps=1.0)
    drive = plan_drive(START, [Follow(LAP, corner_radius_m=0.7), Pause(1.0)], limits, repeats=True)
    lap_s = drive.duration_s
    people = [
        walk([(22.6, 2.8), (22.6, 10.2)], lap_s / 2, speed_mps=0.9),
        walk([(7.1, 5.7), (7.1, 7.3)], lap_s / 4, speed_mps=0.7, pause_s=3.0),
        walk([(4.2, 11.2), (1.9, 10.6), (4.8, 10.5)], lap_s / 2, speed_mps=0.8, pause_s=3.0),
        walk(  # out of a room, ahead of the vehicle along the corridor, back when it is elsewhere
            [(8.05, 1.8), (8.05, 4.1), (16.9, 4.1), (16.9, 6.7), (16.9, 4.1), (8.05, 4.1)],
            lap_s,
            speed_mps=1.2,
            pause_s=(0.0, 0.0, 18.0, 0.0, 0.0),
            begin_s=2.0,
        ),
    ]
    return make_world("office", office_plan(), people, drive)


def office_plan() -> Plan:
    """Walls and furniture alone."""
    plan = Plan()
    _draw_shell(plan)
    _draw_small_rooms(plan)
    _draw_core(plan)
    _furnish_open_plan(plan)
    _furnish_workshop(plan)
    return plan


def _draw_shell(plan: Plan) -> None:
    corners = [(0.0, 0.0), (24.0, 0.0), (24.0, 13.0), (0.0, 13.0)]
    for k in range(4):
        plan.wall(corners[k], corners[(k + 1) % 4], thickness=0.3)
    doorways = [(3.55, 4.65), (8.35, 9.45)]
    plan.wall((6.2, 0.0), (6.2, 13.0), doorways)
    plan.wall((17.8, 0.0), (17.8, 13.0), doorways)
    plan.door((6.1, 3.55), 180.0, 5.0)  # leaves that stand wide open
    plan.door((6.1, 9.45), 180.0, -5.0)
    plan.door((17.9, 3.55), 0.0, -12.0)
    for x in (2.0, 5.0, 19.5, 22.0):  # window pillars
        plan.box((x, 0.2), (0.4, 0.25), reflectivity=0.7)
        plan.box((x, 12.8), (0.4, 0.25), reflectivity=0.7)


def _draw_small_rooms(plan: Plan) -> None:
    doors = [(1.4, 2.3), (5.3, 6.2), (9.2, 10.1)]  # along the corridor's wall, from x = 6.2
    plan.wall((6.2, 3.2), (17.8, 3.2), doors)
    plan.wall((6.2, 9.8), (17.8, 9.8), [(1.6, 2.5), (3.2, 4.4), (5.6, 6.5), (9.0, 9.9)])
    for x in (10.05, 13.95):
        plan.wall((x, 0.0), (x, 3.2))
        plan.wall((x, 9.8), (x, 13.0))
    plan.door((7.6, 3.15), 0.0, -95.0)
    plan.door((11.5, 3.17), 0.0)
    plan.door((16.3, 3.15), 180.0, 40.0)
    plan.door((7.8, 9.83), 0.0)
    plan.door((11.8, 9.85), 0.0, 70.0)
    plan.door((15.2, 9.85), 0.0, 110.0)
    plan.line((9.4, 9.85), (9.4, 10.5), (10.0, 10.5))  # niche with a water dispenser, its side the partition
    plan.box((9.7, 10.3), (0.3, 0.3), reflectivity=0.8)
    for x in (8.6, 12.6, 15.2):
        plan.table((x, 0.9), (1.6, 0.8))
        plan.table((x, 12.0), (1.6, 0.8))
        _chair(plan, (x + 0.2, 1.7), 20.0 * x)
        _chair(plan, (x - 0.2, 11.2), 31.0 * x)
        plan.box((x + 1.0, 2.7), (0.8, 0.4), reflectivity=0.3)


def _draw_core(plan: Plan) -> None:
    plan.wall((8.0, 5.0), (16.0, 5.0), [(3.0, 3.9), (5.0, 6.4)])
    plan.wall((16.0, 5.0), (16.0, 8.0))
    plan.wall((16.0, 8.0), (8.0, 8.0), [(1.2, 2.1), (4.5, 6.0)])
    plan.wall((8.0, 8.0), (8.0, 5.0))
    plan.wall((8.0, 6.5), (16.0, 6.5))
    plan.door((11.0, 5.0), 0.0)
    plan.door((13.9, 8.0), 0.0)
    for x in (12.8, 13.7, 14.6):  # shelves seen through the openings
        plan.box((x, 6.15), (0.8, 0.4), reflectivity=0.3)
        plan.box((x - 2.8, 6.85), (0.8, 0.4), reflectivity=0.5)
    plan.box((9.3, 4.8), (1.0, 0.22), reflectivity=0.2)  # notice board, radiator, bin
    plan.box((15.2, 8.17), (0.9, 0.16), reflectivity=0.7)
    plan.post((15.7, 4.75), 0.15, reflectivity=0.15)


def _furnish_open_plan(plan: Plan) -> None:
    for y in (2.2, 5.2, 7.9, 11.2):
        plan.table((0.95, y), (0.8, 1.6))
        plan.box((0.5, y + 0.5), (0.4, 0.5), reflectivity=0.5)
        _chair(plan, (1.65, y - 0.1), 40.0 * y)
    plan.box((4.4, 6.5), (0.06, 2.4), reflectivity=0.5)  # screen
    plan.box((5.85, 1.6), (0.5, 2.0), reflectivity=0.35)
    plan.box((5.85, 6.6), (0.5, 1.8), reflectivity=0.35)
    plan.box((5.85, 11.6), (0.5, 1.6), reflectivity=0.35)
    plan.post((5.5, 10.0), 0.22, reflectivity=0.3)
    plan.table((3.6, 1.7), (1.4, 1.4), 20.0)
    for k in range(4):
        angle = math.radians(90.0 * k + 20.0)
        _chair(plan, (3.6 + 1.05 * math.cos(angle), 1.7 + 1.05 * math.sin(angle)), 50.0 * k)
    plan.box((2.9, 12.3), (2.0, 0.8), reflectivity=0.25)


def _furnish_workshop(plan: Plan) -> None:
    for x, y in ((19.0, 6.0), (19.0, 7.0)):
        plan.table((x, y), (1.6, 0.8))
    _chair(plan, (19.4, 7.7), 15.0)
    _chair(plan, (18.7, 5.3), 70.0)
    for y in (1.8, 4.2, 6.6, 9.0, 11.4):
        plan.box((23.55, y), (0.5, 1.6), reflectivity=0.3)
    plan.post((18.9, 2.0), 0.2, reflectivity=0.7)
    plan.post((18.9, 11.0), 0.2, reflectivity=0.7)
    plan.box((20.6, 11.4), (1.2, 0.8), 20.0, reflectivity=0.5)
    plan.box((21.6, 1.4), (1.5, 0.7), -15.0, reflectivity=0.5)
    plan.box((22.4, 11.7), (0.6, 0.6), 45.0, reflectivity=0.2)


def _chair(plan: Plan, centre: tuple[float, float], turn_deg: float) -> None:
    """A swivel chair's foot: a column and two crossed bars."""
    plan.box(centre, (0.5, 0.05), turn_deg, 0.2)
    plan.box(centre, (0.05, 0.5), turn_deg, 0.2)
