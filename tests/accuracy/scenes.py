"""Scenes in which a source of motion is wrong: `python -m tests.accuracy.scenes --scene escort` runs one.

A vehicle drives through a place that stands still; then something happens for some seconds; then it is
still again.
"""

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from math import radians

import numpy as np
from scipy.interpolate import CubicSpline

from drivers.frames import LaserScan
from service.kernel_warm_up import warm_up
from service.mapper.profiles import mapping_config
from simulators import disturbances
from simulators.disturbances import GyroFault, Knock, Offset, Slip
from simulators.trajectory import STEP_M, WAY, Limits, X, Y, drive_along
from simulators.truth import LaserTruth, Ride
from simulators.world import World
from simulators.worlds import WORLDS
from tests.accuracy.buildings import LMS100_25HZ
from tests.accuracy.scene_judge import Verdict, judge, trace
from tests.accuracy.trials import ghost_cells
from tests.carried import carried_on, silent
from tests.simulated import Drive, Imu, Laser, Run, Wheels, begun_at, drive, heading_rad, run_session

STAND_S = 0.5
BEFORE_S, AFTER_S = 12.0, 10.0  # still, before and after
GONE_S = 2.0  # a place where a person was so lately may be shown occupied
KNOT_M = 0.05
LEGS = Limits(acceleration_mps2=0.8, lateral_mps2=0.8, turn_rate_radps=1.2)
MOST_PEOPLE = 14
TILT_RAD, LASER_HEIGHT_M = radians(3.0), 0.25
RAMP_M = 2.6
GAPS_M = {
    "office": 0.65,
    "ring": 0.65,
    "library": 1.0,
}  # from the middle of the vehicle to who walks beside it
PLACES = tuple(GAPS_M)
GOOD_WHEELS = Wheels(sigma_m_per_sqrt_m=0.005, sigma_rad_per_sqrt_m=0.003)


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
    has_imu: bool = True

    def __str__(self) -> str:
        return (
            f"{self.scene} {self.world} seed={self.seed} moment={self.moment:.2f}"
            f" speed={self.speed_mps} share={self.share}"
        )


@dataclass(frozen=True)
class Stage:
    """What a scene changes: the world, the sensors, and what they said."""

    case: Case
    world: World
    from_s: float  # of the drive
    to_s: float
    laser: Laser = LMS100_25HZ
    wheels: Wheels | None = GOOD_WHEELS
    imu: Imu | None = field(default_factory=Imu)
    tamper: Callable[[Drive, int, int], Drive] | None = None  # from_ns, to_ns

    @property
    def gap_m(self) -> float:
        return GAPS_M.get(self.case.world, 1.0)


@dataclass(frozen=True)
class Scene:
    """what happens, and for how long"""

    what: str
    change: Callable[[Stage], Stage]
    for_s: float = 12.0
    is_bound: bool = True  # wheels and gyro are good: the pose itself has to be


def _people(
    offsets: Callable[[int, float], list[Offset]], beyond_m: float, speed: float | None, stage: Stage
):
    """As many as it takes for their share of the returns, at most MOST_PEOPLE."""
    for count in range(1, MOST_PEOPLE + 1):
        world = disturbances.with_companions(
            stage.world,
            offsets(count, stage.gap_m + beyond_m),
            stage.from_s,
            stage.to_s,
            speed_mps=None if speed is None else speed * stage.case.speed_mps,
            seed=stage.case.seed,
        )
        staged = replace(stage, world=world)
        if returns_share(stage, staged) >= stage.case.share:
            break
    return staged


def _train(speed: float | None, stage: Stage) -> Stage:
    """Its length makes its share of the returns."""
    for length_m in (1.0, 2.0, 3.0, 5.0, 8.0, 12.0, 20.0, 40.0):
        world = disturbances.with_train(
            stage.world,
            stage.from_s,
            stage.to_s,
            left_m=stage.gap_m,
            length_m=length_m,
            speed_mps=None if speed is None else speed * stage.case.speed_mps,
        )
        staged = replace(stage, world=world)
        if returns_share(stage, staged) >= stage.case.share:
            break
    return staged


def _floor(distance_m: float, stage: Stage) -> Stage:
    laser = stage.laser
    world = disturbances.with_floor_seen(
        stage.world, laser.name, laser.mounting, distance_m, stage.from_s, stage.to_s, LASER_HEIGHT_M
    )
    return replace(stage, world=world)


def _knocked(yaw_rad: float, stage: Stage) -> Stage:
    return replace(stage, laser=replace(stage.laser, knocks=(Knock(stage.from_s, stage.to_s, yaw_rad),)))


def _slipping(way: float, turn: float, stage: Stage) -> Stage:
    slips = (Slip(stage.from_s, stage.to_s, way, turn),)
    return replace(stage, wheels=None if stage.wheels is None else replace(stage.wheels, slips=slips))


def _gyro(bias_radps: float, is_frozen: bool, stage: Stage) -> Stage:
    faults = (GyroFault(stage.from_s, stage.to_s, bias_radps, is_frozen),)
    return replace(stage, imu=None if stage.imu is None else replace(stage.imu, faults=faults))


def _alone(stage: Stage) -> Stage:
    return replace(stage, wheels=None, imu=None)


def _laser_silent(made: Drive, from_ns: int, to_ns: int) -> Drive:
    left = [f for f in made.frames if not (isinstance(f, LaserScan) and from_ns <= f.arrived_ns < to_ns)]
    return replace(made, frames=left)


def _lifted(made: Drive, from_ns: int, to_ns: int) -> Drive:
    return carried_on(made, from_ns, to_ns - from_ns)


def _off(made: Drive, from_ns: int, to_ns: int) -> Drive:
    return silent(made, from_ns, to_ns - from_ns)


def _biased(stage: Stage) -> Stage:
    return replace(stage, laser=replace(stage.laser, model=replace(stage.laser.model, bias_m=0.03)))


def _tampered(tamper: Callable[[Drive, int, int], Drive], stage: Stage) -> Stage:
    return replace(stage, tamper=tamper)


SCENES: dict[str, Scene] = {
    "still": Scene("nothing happens", lambda stage: stage),
    "escort": Scene("people walk along on both sides", partial(_people, disturbances.beside, 0.0, None)),
    "escort_alone": Scene(
        "the same, laser alone",
        lambda stage: _alone(_people(disturbances.beside, 0.0, None, stage)),
        is_bound=False,
    ),
    "overtaking": Scene(
        "people walk by on both sides, 1.3 times as fast",
        partial(_people, disturbances.beside, 0.0, 1.3),
    ),
    "ring_of_people": Scene(
        "a ring of people goes along", partial(_people, disturbances.around, 0.2, None), 8.0
    ),
    "ahead": Scene("people walk ahead", partial(_people, disturbances.ahead, 0.6, None), 10.0),
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
    "knocked": Scene("the laser stands turned by 5 deg", partial(_knocked, radians(5.0))),
    "wheels_frozen": Scene(
        "the wheels stand while the vehicle drives", partial(_slipping, 0.0, 0.0), is_bound=False
    ),
    "wheels_spin": Scene("the wheels roll 1.5 times the way", partial(_slipping, 1.5, 1.0), is_bound=False),
    "towed": Scene(
        "wheels frozen and laser silent",
        lambda stage: _tampered(_laser_silent, _slipping(0.0, 0.0, stage)),
        3.0,
        is_bound=False,
    ),
    "laser_silent": Scene("the laser is silent", partial(_tampered, _laser_silent), 5.0),
    "all_silent": Scene("all sensors are silent, the wheels count on", partial(_tampered, _off), 5.0),
    "lifted": Scene(
        "lifted and carried on, all sensors silent", partial(_tampered, _lifted), 5.0, is_bound=False
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
    returns: float  # share of the returns that the scene changes half-way

    @property
    def is_still(self) -> bool:
        return self.case.scene in ("still", "range_bias")


def staged(case: Case) -> Staged:
    """Same case, same frames."""
    scene = SCENES[case.scene]
    for_s = scene.for_s if case.for_s is None else case.for_s
    plain = driven(WORLDS[case.world](), case.moment, case.speed_mps, BEFORE_S + for_s + AFTER_S)
    world = begun_at(plain, heading_rad(case.seed))
    turned_s = world.drive.duration_s - plain.drive.duration_s
    from_s = turned_s + BEFORE_S
    still = Stage(case, world, from_s, from_s + for_s, imu=Imu() if case.has_imu else None)
    stage = scene.change(still)
    seconds = STAND_S + stage.to_s + AFTER_S
    made = drive(stage.world, stage.laser, seconds, case.seed, stage.wheels, stage.imu, STAND_S)
    from_ns, to_ns = (round((STAND_S + at_s) * 1e9) for at_s in (stage.from_s, stage.to_s))
    if stage.tamper is not None:
        made = stage.tamper(made, from_ns, to_ns)
    return Staged(case, stage.world, made, from_ns, to_ns, returns_share(still, stage))


def driven(world: World, moment: float, speed_mps: float, seconds: float) -> World:
    """The world without its people, driven on the way of its lap for at least so long, from rest at this part
    of the lap on.
    """
    nodes = world.drive.nodes
    way, first = np.unique(nodes[:, WAY], return_index=True)
    knots = np.unique(np.searchsorted(way, np.arange(0.0, way[-1], KNOT_M)))
    knots = np.append(knots[way[knots] < way[-1] - KNOT_M], len(way) - 1)
    places = nodes[first][:, X : Y + 1][knots]
    places[-1] = places[0]  # of a lap
    lap = CubicSpline(way[knots], places, bc_type="periodic")
    begin_m = moment * way[-1]
    along_m = np.arange(begin_m, begin_m + speed_mps * seconds + 1.0, STEP_M)
    return replace(world, people=(), drive=drive_along(lap(along_m), replace(LEGS, speed_mps=speed_mps)))


def returns_share(still: Stage, stage: Stage) -> float:
    """Of the returns, those that are others than where all is still; in the mean of three moments."""
    shares = []
    for at_s in np.linspace(stage.from_s, stage.to_s, 5)[1:4]:
        ranges = []
        for one in (still, stage):
            source = LaserTruth(
                Ride(one.world, 0, 0.0),
                one.laser.name,
                one.laser.mounting,
                one.laser.model,
                0,
                one.laser.knocks,
            )
            sweep = (round(at_s * 1e9), one.laser.beam_ns, radians(one.laser.first_deg))
            ranges.append(source.view(*sweep, radians(one.laser.step_deg), one.laser.beams).true_m)
        seen = np.isfinite(ranges[1])
        shares.append(float(np.mean(ranges[0][seen] != ranges[1][seen])) if seen.any() else 0.0)
    return float(np.mean(shares))


def verdict_of(of: Staged, done: Run) -> Verdict:
    truth = [of.made.truth[output.stamp_ns] for output in done.outputs]
    ghosts = ghost_cells(of.world, of.made, done, GONE_S)
    return judge(done.outputs, truth, of.from_ns, of.to_ns, ghosts)


def mapped(of: Staged, profile: str = "corridor") -> Run:
    return run_session(mapping_config({"profile": profile}), of.made)


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.accuracy.scenes", description=__doc__)
    parser.add_argument("--scene", action="append", choices=sorted(SCENES), default=[], help="all")
    parser.add_argument("--world", action="append", choices=sorted(WORLDS), default=[], help=" ".join(PLACES))
    parser.add_argument("--seed", action="append", type=int, default=[], help="11")
    parser.add_argument(
        "--moment", action="append", type=float, default=[], help="part of the lap, 0 to 1; 0"
    )
    parser.add_argument("--speed", action="append", type=float, default=[], help="m/s; 1")
    parser.add_argument("--share", action="append", type=float, default=[], help="of the returns; 0.33")
    parser.add_argument("--for-s", type=float, help="how long it lasts; as the scene has it")
    parser.add_argument("--no-imu", action="store_true")
    parser.add_argument("--profile", default="corridor")
    parser.add_argument("--trace", action="store_true", help="a line for each second")
    parsed = parser.parse_args(arguments)
    warm_up()
    for case in (
        Case(scene, world, seed, moment, speed, share, parsed.for_s, not parsed.no_imu)
        for scene in parsed.scene or SCENES
        for world in parsed.world or PLACES
        for seed in parsed.seed or (11,)
        for moment in parsed.moment or (0.0,)
        for speed in parsed.speed or (1.0,)
        for share in parsed.share or (0.33,)
    ):
        began_s = time.process_time()
        of = staged(case)
        made_s = time.process_time() - began_s
        done = mapped(of, parsed.profile)
        if parsed.trace:
            truth = [of.made.truth[output.stamp_ns] for output in done.outputs]
            print(f"{case}: from {of.from_ns * 1e-9:.2f} to {of.to_ns * 1e-9:.2f} s")
            print("\n".join(trace(done.outputs, truth, of.from_ns)))
        took_s = time.process_time() - began_s - made_s
        print(
            f"{case} returns={of.returns:.2f} {verdict_of(of, done).line()} cpu_s={made_s:.1f}+{took_s:.1f}",
            flush=True,
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
