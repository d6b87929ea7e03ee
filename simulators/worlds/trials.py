"""Places and drives with one difficulty each: turns, crowds, glass, no geometry to match."""

import math

import numpy as np

from service.geometry.se2 import SE2
from simulators.trajectory import Follow, Leg, Limits, Pause, Spin, Trajectory, plan_drive
from simulators.world import Plan, Walk, World, make_world
from simulators.worlds.office import LAP, START, office_plan

ROOM_M = 10.0
START_XY = (START.x_m, START.y_m)
STEP_S = 0.2  # between two positions of a person in a crowd
LEAVING_S, AWAY_S = 12.0, 25.0  # the crowd leaves so long before the end of a lap, for so long


def room() -> World:
    """A bare square, the vehicle in its middle: the information of one scan is known in closed form."""
    plan = Plan()
    half = ROOM_M / 2.0
    plan.line((-half, -half), (half, -half), (half, half), (-half, half), (-half, -half))
    return make_world("room", plan, [], plan_drive(SE2(), [Pause(1.0)], repeats=True))


def featureless() -> World:
    """A bare corridor of 160 x 2.4 m; the first 100 m of the drive never come within 20 m of its ends."""
    plan = Plan()
    plan.line((-30.0, -1.2), (130.0, -1.2), (130.0, 1.2), (-30.0, 1.2), (-30.0, -1.2))
    out_and_back: list[Leg] = [Follow([(100.0, 0.0)]), Spin(math.pi), Follow([(0.0, 0.0)]), Spin(-math.pi)]
    return make_world("featureless", plan, [], plan_drive(SE2(), [*out_and_back, Pause(1.0)], repeats=True))


def spins() -> World:
    """The office, turning on the spot at 3 rad/s in the open plan, the corridor and the workshop."""
    two_turns = 4.0 * math.pi
    legs: list[Leg] = [Spin(two_turns), Spin(-two_turns)]
    for points in ([(2.8, 4.1), (7.2, 4.1)], [(21.0, 4.1), (21.0, 6.5)], [(21.0, 8.9), (12.0, 8.9)]):
        legs += [Follow(points), Spin(two_turns), Spin(-two_turns)]
    legs += [Follow([(2.8, 8.9), START_XY]), Pause(1.0)]
    limits = Limits(turn_rate_radps=3.0, turn_acceleration_radps2=8.0)
    return make_world("spins", office_plan(), [], plan_drive(START, legs, limits, repeats=True))


def stop_and_go() -> World:
    """The office, stopping every two metres or so."""
    legs: list[Leg] = []
    here = np.array(START_XY)
    for corner in np.array(LAP):
        segments = max(1, round(float(np.hypot(*(corner - here))) / 2.0))
        for k in range(1, segments + 1):
            x, y = here + (corner - here) * k / segments
            legs += [Follow([(float(x), float(y))]), Pause(0.5)]
        here = corner
    limits = Limits(acceleration_mps2=1.5, turn_rate_radps=1.5)
    return make_world("stop_and_go", office_plan(), [], plan_drive(START, legs, limits, repeats=True))


def crowd() -> World:
    """A hall of 20 x 14 m; five people walk within 3 m of the vehicle, then leave."""
    plan = Plan()
    corners = [(0.0, 0.0), (20.0, 0.0), (20.0, 14.0), (0.0, 14.0)]
    for k in range(4):
        plan.sunk_doors(corners[k], corners[(k + 1) % 4], (2.5 + 0.4 * k, 8.0), depth=-0.3, width=1.2)
    for centre in ((9.0, 7.0), (11.5, 6.6), (1.0, 13.0), (19.0, 0.9)):
        plan.box(centre, (1.6, 0.8), 17.0 * centre[0])
    lap = [(16.0, 4.0), (16.0, 10.0), (4.0, 10.0), (4.0, 4.0), (6.0, 4.0)]
    legs: list[Leg] = [Follow(lap), Pause(LEAVING_S + AWAY_S)]
    drive = plan_drive(SE2(6.0, 4.0, 0.0), legs, Limits(lateral_mps2=0.8), repeats=True)
    places = [(1.7, 0.9), (1.9, -0.8), (-0.3, 1.5), (-0.2, -1.5), (-1.8, 0.2)]
    people = [_companion(drive, k, *place) for k, place in enumerate(places)]
    return make_world("crowd", plan, people, drive)


def _companion(drive: Trajectory, number: int, ahead_m: float, left_m: float) -> Walk:
    """Stays about there beside the vehicle, walks into a corner while it stands, and returns."""
    along_s = np.arange(0.0, drive.duration_s - AWAY_S - LEAVING_S, STEP_S)
    x, y, theta = drive.poses(along_s).T
    ahead = ahead_m + 0.25 * np.sin(0.9 * along_s + number)
    left = left_m + 0.2 * np.sin(0.6 * along_s + 2.0 * number)
    with_it = np.column_stack(
        [x + ahead * np.cos(theta) - left * np.sin(theta), y + ahead * np.sin(theta) + left * np.cos(theta)]
    )
    with_it = np.clip(with_it, 0.5, (19.5, 13.5))
    corner = np.array([17.5 + 0.4 * number, 11.0 + 0.5 * number])
    side = drive.start.y_m + math.copysign(1.6, left_m)  # clear of the vehicle on the drive out and back
    stepped, passed = np.array([with_it[-1][0], side]), np.array([10.0, side])
    gone_s = float(along_s[-1])
    times_s = [*along_s, gone_s + 2.0, gone_s + LEAVING_S / 2.0, gone_s + LEAVING_S]
    places = [*with_it, stepped, passed, corner]
    back_s = drive.duration_s - LEAVING_S
    times_s += [back_s, back_s + LEAVING_S / 2.0, drive.duration_s - 2.0, drive.duration_s]
    places += [corner, passed, np.array([with_it[0][0], side]), with_it[0]]
    return Walk(tuple(map(float, times_s)), tuple((float(px), float(py)) for px, py in places))


def glass_hall(glass: bool = True) -> World:
    """A hall of 24 x 10 m, one long side of panes with a yard behind them; or the same side bricked up."""
    plan = Plan()
    plan.line((0.0, 10.0), (0.0, 0.0), (24.0, 0.0), (24.0, 10.0))
    for x in np.arange(0.0, 24.1, 3.0):
        plan.box((float(x), 10.0), (0.12, 0.12))
    for x in np.arange(0.0, 23.9, 3.0):
        plan.line((float(x) + 0.06, 10.0), (float(x) + 2.94, 10.0), glass=glass)
    plan.line((0.0, 10.1), (0.0, 14.5), (24.0, 14.5), (24.0, 10.1))
    for x, y in ((5.0, 12.8), (13.5, 13.2), (19.0, 12.5)):
        plan.post((x, y), 0.4)
    for x, y in ((9.0, 5.0), (15.0, 5.2), (1.0, 1.0), (22.8, 0.8)):
        plan.box((x, y), (1.4, 0.7), 11.0 * x)
    lap = [(21.0, 2.5), (21.0, 7.5), (3.0, 7.5), (3.0, 2.5), (6.0, 2.5)]
    legs: list[Leg] = [Follow(lap), Pause(1.0)]
    drive = plan_drive(SE2(6.0, 2.5, 0.0), legs, repeats=True)
    return make_world("glass_hall", plan, [], drive)
