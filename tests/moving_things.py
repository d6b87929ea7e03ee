"""Worlds in which things move with the vehicle for a while: people who walk along, a train, a floor that a
tilted laser sees.

Times are those of the drive, seconds since it began. Everything is a function of its arguments and a seed.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from service.geometry.se2 import SE2
from simulators.trajectory import Floats, Trajectory
from simulators.world import PERSON_RADIUS_M, Mover, Walk, World

STEP_S = 0.1  # between the places that a walk or a path is made of
FLOOR_STEP_S = 0.02
LOOK_AHEAD_S = 60.0  # of the drive: people ahead of the vehicle follow its path so far
FOR_EVER_S = 1e9
SWAY_RADPS = (3.0, 6.0)  # of a person to and fro: about a step a second
FLOOR_REFLECTIVITY = 0.3
FLOOR_HALF_M = 50.0  # of the line, to either side

Offset = tuple[float, float]  # m ahead of the base, along the path of the vehicle, and m left of it


def beside(count: int, gap_m: float) -> list[Offset]:
    """In two files, gap_m to the left and to the right, the vehicle among them."""
    ahead_m = [0.9, -0.5, 0.2, 1.6, -1.2, 2.3, -1.9, 3.0]
    return [(ahead_m[(k // 2) % len(ahead_m)], gap_m if k % 2 == 0 else -gap_m) for k in range(count)]


def ahead(count: int, gap_m: float) -> list[Offset]:
    """In rows of two ahead of the vehicle, the first gap_m ahead, staggered so that each can be seen."""
    return [(gap_m + 0.6 * (k // 2), (0.35 + 0.25 * (k // 2)) * (-1) ** k) for k in range(count)]


def around(count: int, gap_m: float) -> list[Offset]:
    """In a ring round the vehicle."""
    angles = [2.0 * math.pi * (k + 0.5) / count for k in range(count)]
    return [(gap_m * math.cos(angle), gap_m * math.sin(angle)) for angle in angles]


def with_companions(
    world: World,
    offsets: Sequence[Offset],
    from_s: float,
    to_s: float,
    *,
    speed_mps: float | None = None,
    sway_m: float = 0.03,
    stay: bool = False,
    seed: int = 0,
) -> World:
    """The world with people who walk along with the vehicle from from_s to to_s, one at each of `offsets`.

    They follow the path of the vehicle, before and behind it too, and sway a little.
    speed_mps  of their own, along that path; None: as fast as the vehicle
    stay       they stand where they are at to_s from then on; else there is no one before and after
    """
    time_s = np.append(np.arange(from_s, to_s, STEP_S), to_s)
    noise = np.random.default_rng(seed)
    people = []
    for ahead_m, left_m in offsets:
        pace, begin = noise.uniform(*SWAY_RADPS, 2), noise.uniform(0.0, 2.0 * math.pi, 2)
        sway = sway_m * np.sin(time_s[:, None] * pace + begin)
        path_length_m = _path_length_m(world.drive, time_s, speed_mps) + ahead_m + sway[:, 0]
        places = _beside_path(world.drive, time_s, path_length_m, left_m + sway[:, 1])[:, :2]
        times_s = [0.0, *time_s.tolist(), FOR_EVER_S] if from_s > 0.0 else [*time_s.tolist(), FOR_EVER_S]
        stands = [*([places[0]] if from_s > 0.0 else []), *places, places[-1]]
        people.append(
            Walk(
                tuple(times_s),
                tuple((float(x), float(y)) for x, y in stands),
                PERSON_RADIUS_M,
                from_s,
                math.inf if stay else to_s,
            )
        )
    return replace(world, people=(*world.people, *people))


def with_train(
    world: World,
    from_s: float,
    to_s: float,
    *,
    left_m: float,
    length_m: float = 12.0,
    width_m: float = 1.0,
    speed_mps: float | None = None,
    reflectivity: float = 0.5,
) -> World:
    """The world with a train, a truck, a row of trolleys on the path of the vehicle, from from_s to to_s.

    left_m     of its near side from the middle of the vehicle; negative: on the right
    speed_mps  None: as fast as the vehicle, its middle beside it all the time; else its middle passes the
               vehicle midway between from_s and to_s, negative: it comes towards it
    """
    time_s = np.append(np.arange(from_s, to_s, STEP_S), to_s)
    path_length_m = _path_length_m(world.drive, time_s, speed_mps)
    if speed_mps is not None:
        middle_s = (from_s + to_s) / 2.0
        path_length_m += float(world.drive.travel(np.array([middle_s]))[0, 0]) - float(
            np.interp(middle_s, time_s, path_length_m)
        )
    path = np.column_stack([time_s, _beside_path(world.drive, time_s, path_length_m, np.zeros(len(time_s)))])
    half_m, far_m = length_m / 2.0, left_m + math.copysign(width_m, left_m)
    corners = [(-half_m, left_m), (half_m, left_m), (half_m, far_m), (-half_m, far_m)]
    faces = np.array([(*corners[k], *corners[(k + 1) % 4]) for k in range(4)])
    return replace(world, movers=(*world.movers, Mover(faces, path, from_s, to_s, reflectivity)))


def with_floor_seen(
    world: World,
    sensor: str,
    mounting: SE2,
    distance_m: float,
    from_s: float,
    to_s: float,
    height_m: float = 0.25,
) -> World:
    """The world in which a laser at this height meets the floor so far ahead: the vehicle comes to a ramp, or
    the laser is tilted by atan(height_m / distance_m).

    The line where it meets the floor goes along with the vehicle, across the laser's view ahead. Ranges are
    those in the plane: the true ones are longer by 1 / cos of the tilt, 0.14 % at 3 deg.
    """
    time_s = np.append(np.arange(from_s, to_s, FLOOR_STEP_S), to_s)
    x, y, theta = world.drive.poses(time_s).T
    c, s = np.cos(theta), np.sin(theta)
    at = [x + c * mounting.x_m - s * mounting.y_m, y + s * mounting.x_m + c * mounting.y_m]
    path = np.column_stack([time_s, *at, theta + mounting.theta_rad])
    line = np.array([[distance_m, -FLOOR_HALF_M, distance_m, FLOOR_HALF_M]])
    light = FLOOR_REFLECTIVITY * height_m / math.hypot(height_m, distance_m)  # the beams graze it
    return replace(world, movers=(*world.movers, Mover(line, path, from_s, to_s, light, sensor)))


def _path_length_m(drive: Trajectory, time_s: Floats, speed_mps: float | None) -> Floats:
    """(N,) along the path of the vehicle, from where the vehicle is at the first of these times."""
    path_length_m = drive.travel(time_s)[:, 0]
    return path_length_m if speed_mps is None else path_length_m[0] + speed_mps * (time_s - time_s[0])


def _beside_path(drive: Trajectory, time_s: Floats, path_length_m: Floats, left_m: Floats) -> Floats:
    """(N, 3) x m, y m, theta rad left of the vehicle's path; straight on beyond its ends."""
    seconds = np.arange(0.0, float(time_s[-1]) + LOOK_AHEAD_S, STEP_S / 2.0)
    travel_m, first = np.unique(drive.travel(seconds)[:, 0], return_index=True)
    poses = drive.poses(seconds[first])
    ahead_m = path_length_m - np.clip(path_length_m, travel_m[0], travel_m[-1])
    x, y, theta = (np.interp(path_length_m, travel_m, column) for column in poses.T)
    c, s = np.cos(theta), np.sin(theta)
    beside_path: Floats = np.column_stack([x + ahead_m * c - left_m * s, y + ahead_m * s + left_m * c, theta])
    return beside_path
