"""Drives through scenes in which a source of motion is wrong: motion of the world and measurements."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from math import radians

import numpy as np
from scipy.interpolate import CubicSpline

from simulators.device import Beams
from simulators.disturbances import Knock, Slip
from simulators.trajectory import PATH_LENGTH, STEP_M, Limits, X, Y, drive_along
from simulators.truth import LaserTruth, Ride
from simulators.world import World
from simulators.worlds import WORLDS
from tests.accuracy.buildings import LMS100_25HZ
from tests.accuracy.sensors import GOOD_WHEELS
from tests.carried import carried_on, laser_silent, silent
from tests.moving_things import Offset, ahead, around, beside, with_companions, with_floor_seen, with_train
from tests.simulated import Drive, GyroFault, Imu, Laser, Wheels, begun_at, drive, heading_rad

STAND_S = 0.5
BEFORE_S, AFTER_S = 12.0, 10.0  # still, before and after
KNOT_M = 0.05  # of the spline through the path of a lap
LEGS = Limits(acceleration_mps2=0.8, lateral_mps2=0.8, turn_rate_radps=1.2)
MAX_PEOPLE = 14
TRAINS_M = (1.0, 2.0, 3.0, 5.0, 8.0, 12.0, 20.0, 40.0)
TILT_RAD, LASER_HEIGHT_M = radians(3.0), 0.25
RAMP_M = 2.6
GAPS_M = {
    "office": 0.65,
    "ring": 0.65,
    "library": 1.0,
}  # from the vehicle's middle to people beside it
PLACES = tuple(GAPS_M)


@dataclass(frozen=True)
class Case:
    """One run of a scene."""

    scene: str
    world: str = "office"
    seed: int = 11
    moment: float = 0.0  # where on the lap the drive begins, 0 to 1
    speed_mps: float = 1.0
    share: float = 0.33  # of the returns, from people or a train
    for_s: float | None = None  # how long it lasts; None: as the scene has it
    before_s: float = BEFORE_S  # from the begin of the drive
    has_imu: bool = True
    laser: Laser = LMS100_25HZ

    def __str__(self) -> str:
        return (
            f"{self.scene} {self.world} seed={self.seed} moment={self.moment:.2f}"
            f" speed={self.speed_mps} share={self.share}"
        )


@dataclass(frozen=True)
class Stage:
    """Changes of a scene: the world, the sensors, and the frames."""

    case: Case
    world: World
    from_s: float  # of the drive
    to_s: float
    laser: Laser
    wheels: Wheels | None = GOOD_WHEELS
    imu: Imu | None = field(default_factory=Imu)
    tamper: Callable[[Drive, int, int], Drive] | None = None  # at_ns, for_ns


@dataclass(frozen=True)
class Scene:
    """What happens, and for how long."""

    what: str
    change: Callable[[Stage], Stage]
    for_s: float = 12.0
    is_bound: bool = True  # wheels and gyro are good: the pose itself has to be


def _with_share(stage: Stage, worlds: Iterable[World]) -> Stage:
    """In the first world in which enough returns are others than in that of the stage, or in the last."""
    for world in worlds:
        there = replace(stage, world=world)
        if returns_share(stage, there) >= stage.case.share:
            break
    return there


def _people(
    offsets: Callable[[int, float], list[Offset]],
    beyond_m: float,
    speed: float | None,
    stage: Stage,
    counts: Sequence[int] = range(1, MAX_PEOPLE + 1),
) -> Stage:
    """As many of these as it takes for their share of the returns.

    beyond_m   added to the gap of the place
    speed      theirs, in that of the vehicle; None: they go along
    """
    gap_m = GAPS_M[stage.case.world] + beyond_m
    speed_mps = None if speed is None else speed * stage.case.speed_mps
    span = stage.from_s, stage.to_s
    worlds = (
        with_companions(stage.world, offsets(count, gap_m), *span, speed_mps=speed_mps, seed=stage.case.seed)
        for count in counts
    )
    return _with_share(stage, worlds)


def _train(speed: float | None, stage: Stage) -> Stage:
    """So long that it makes its share of the returns; of one side it can be half."""
    left_m = GAPS_M[stage.case.world]
    speed_mps = None if speed is None else speed * stage.case.speed_mps
    span = stage.from_s, stage.to_s
    worlds = (
        with_train(stage.world, *span, left_m=left_m, length_m=length_m, speed_mps=speed_mps)
        for length_m in TRAINS_M
    )
    return _with_share(stage, worlds)


def _floor(distance_m: float, stage: Stage) -> Stage:
    laser = stage.laser
    world = with_floor_seen(
        stage.world, laser.name, laser.mounting, distance_m, stage.from_s, stage.to_s, LASER_HEIGHT_M
    )
    return replace(stage, world=world)


def _knocked(yaw_rad: float, stage: Stage) -> Stage:
    return replace(stage, laser=replace(stage.laser, knocks=(Knock(stage.from_s, stage.to_s, yaw_rad),)))


def _slipping(distance: float, turn: float, stage: Stage) -> Stage:
    slips = (Slip(stage.from_s, stage.to_s, distance, turn),)
    return replace(stage, wheels=None if stage.wheels is None else replace(stage.wheels, slips=slips))


def _gyro(bias_radps: float, is_frozen: bool, stage: Stage) -> Stage:
    faults = (GyroFault(stage.from_s, stage.to_s, bias_radps, is_frozen),)
    return replace(stage, imu=None if stage.imu is None else replace(stage.imu, faults=faults))


def _alone(stage: Stage) -> Stage:
    return replace(stage, wheels=None, imu=None)


def _biased(stage: Stage) -> Stage:
    return replace(stage, laser=replace(stage.laser, model=replace(stage.laser.model, bias_m=0.03)))


def _tampered(tamper: Callable[[Drive, int, int], Drive], stage: Stage) -> Stage:
    return replace(stage, tamper=tamper)


SCENES: dict[str, Scene] = {
    "still": Scene("nothing happens", lambda stage: stage),
    "escort": Scene("people walk along on both sides", partial(_people, beside, 0.0, None)),
    "escort_alone": Scene(
        "the same, laser alone", lambda stage: _alone(_people(beside, 0.0, None, stage)), is_bound=False
    ),
    "overtaking": Scene(
        "people walk by on both sides, 1.3 times as fast", partial(_people, beside, 0.0, 1.3)
    ),
    "ring_of_people": Scene("a ring of people goes along", partial(_people, around, 0.2, None), 8.0),
    "ahead": Scene("six people walk ahead", partial(_people, ahead, 0.6, None, counts=(6,)), 10.0),
    "train_along": Scene("a train goes along on the left", partial(_train, None)),
    "train_passing": Scene("a train passes on the left, twice as fast", partial(_train, 2.0)),
    "tilted": Scene(
        "the laser is tilted by 3 deg and sees the floor 4.8 m ahead",
        partial(_floor, LASER_HEIGHT_M / np.tan(TILT_RAD)),
        15.0,
    ),
    "ramp": Scene("the laser sees a ramp 2.6 m ahead", partial(_floor, RAMP_M), 4.0),
    "ramp_alone": Scene(
        "the same, laser alone", lambda stage: _alone(_floor(RAMP_M, stage)), 4.0, is_bound=False
    ),
    "knocked": Scene("the laser is turned by 5 deg", partial(_knocked, radians(5.0))),
    "wheels_frozen": Scene(
        "the wheels stand while the vehicle drives", partial(_slipping, 0.0, 0.0), is_bound=False
    ),
    "wheels_spin": Scene(
        "the wheels roll 1.5 times the distance", partial(_slipping, 1.5, 1.0), is_bound=False
    ),
    "towed": Scene(
        "wheels frozen and laser silent",
        lambda stage: _tampered(laser_silent, _slipping(0.0, 0.0, stage)),
        3.0,
        is_bound=False,
    ),
    "laser_silent": Scene("the laser is silent", partial(_tampered, laser_silent), 5.0),
    "all_silent": Scene("all sensors are silent, the wheels count on", partial(_tampered, silent), 5.0),
    "lifted": Scene(
        "lifted and carried on, all sensors silent", partial(_tampered, carried_on), 5.0, is_bound=False
    ),
    "gyro_bias": Scene("the gyro's bias jumps to 0.1 rad/s", partial(_gyro, 0.1, False), is_bound=False),
    "gyro_frozen": Scene("the gyro repeats its last rate", partial(_gyro, 0.0, True), is_bound=False),
    "range_bias": Scene("all ranges 30 mm too long", _biased),
}


@dataclass(frozen=True)
class Staged:
    """A drive through a scene."""

    case: Case
    world: World
    made: Drive
    from_ns: int
    to_ns: int
    returns: float  # share of the returns that the scene changes


def staged(case: Case, after_s: float = AFTER_S) -> Staged:
    """Same case, same frames, until so long after the scene."""
    for_s = seconds_of(case)
    plain = driven(WORLDS[case.world](), case.moment, case.speed_mps, case.before_s + for_s + AFTER_S)
    world = begun_at(plain, heading_rad(case.seed))
    from_s = world.drive.duration_s - plain.drive.duration_s + case.before_s
    still = Stage(case, world, from_s, from_s + for_s, case.laser, imu=Imu() if case.has_imu else None)
    stage = SCENES[case.scene].change(still)
    seconds = STAND_S + stage.to_s + after_s
    made = drive(stage.world, stage.laser, seconds, case.seed, stage.wheels, stage.imu, STAND_S)
    from_ns, to_ns = (round((STAND_S + at_s) * 1e9) for at_s in (stage.from_s, stage.to_s))
    if stage.tamper is not None:
        made = stage.tamper(made, from_ns, to_ns - from_ns)
    return Staged(case, stage.world, made, from_ns, to_ns, returns_share(still, stage))


def seconds_of(case: Case) -> float:
    return SCENES[case.scene].for_s if case.for_s is None else case.for_s


def driven(world: World, moment: float, speed_mps: float, seconds: float) -> World:
    """The world without its people, driven along its lap for at least so long, from rest at this part of the
    lap on. The lap has to close without a turn on the spot, as those of PLACES do.
    """
    nodes = world.drive.nodes
    path_length_m, first = np.unique(nodes[:, PATH_LENGTH], return_index=True)
    knots = np.unique(np.searchsorted(path_length_m, np.arange(0.0, path_length_m[-1], KNOT_M)))
    knots = np.append(knots[path_length_m[knots] < path_length_m[-1] - KNOT_M], len(path_length_m) - 1)
    places = nodes[first][:, X : Y + 1][knots]
    places[-1] = places[0]  # of a lap
    lap = CubicSpline(path_length_m[knots], places, bc_type="periodic")
    begin_m = moment * path_length_m[-1]
    along_m = np.arange(begin_m, begin_m + speed_mps * seconds + 1.0, STEP_M)
    return replace(world, people=(), drive=drive_along(lap(along_m), replace(LEGS, speed_mps=speed_mps)))


def returns_share(still: Stage, stage: Stage) -> float:
    """Of the returns, those that are others than where all is still; in the mean of three moments."""
    shares = []
    for at_s in np.linspace(stage.from_s, stage.to_s, 5)[1:4]:
        ranges = []
        for one in (still, stage):
            laser, ride = one.laser, Ride(one.world, 0, 0.0)
            source = LaserTruth(ride, laser.name, laser.mounting, laser.model, 0, laser.knocks)
            first_rad, step_rad = radians(laser.first_deg), radians(laser.step_deg)
            beams = Beams(round(at_s * 1e9), laser.beam_ns, first_rad, step_rad, laser.beams)
            ranges.append(source.view(beams).true_m)
        seen = np.isfinite(ranges[1])
        shares.append(float(np.mean(ranges[0][seen] != ranges[1][seen])) if seen.any() else 0.0)
    return float(np.mean(shares))
