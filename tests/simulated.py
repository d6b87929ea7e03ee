"""Drives through simulated worlds without drivers or wires: frames in order of arrival, with the truth.

For experiments and benchmarks of the mapper. What the wire does to a frame is tested elsewhere.
"""

import math
import time
from bisect import bisect_right
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from drivers.frames import NO_INTENSITY, Frame, ImuSample, LaserScan, OdometrySample
from service.geometry.se2 import SE2
from service.mapper.mapping_session import MappingSession
from service.mapper.pipeline import Mapper
from service.mapper.profiles import MappingConfig, build_mapper
from service.outputs import MapperOutput
from simulators.device import Beams
from simulators.disturbances import Knock, Slip
from simulators.trajectory import THETA, Spin, X, Y, plan_drive
from simulators.truth import LMS100, UTM30LX, LaserModel, LaserTruth, Ride, noise_of
from simulators.world import World

ODOMETRY_NS = 15_000_000
IMU_NS = 5_000_000
ORIGIN = SE2()
FORWARD = SE2(0.2, 0.0, 0.0)
MAX_PHASE_M = 0.1  # no cell of a profile is wider


@dataclass(frozen=True, slots=True)
class GyroFault:
    """The gyroscope measures its last rate again and again, or the true one and a bias."""

    from_s: float
    to_s: float
    bias_radps: float = 0.0
    is_frozen: bool = False


@dataclass(frozen=True)
class Laser:
    """A scanner on the vehicle. Its mirror turns 360 deg a period, so beams follow at step / 360 of it."""

    model: LaserModel
    beams: int
    rate_hz: float
    first_deg: float
    step_deg: float
    mounting: SE2 = FORWARD
    name: str = "front"
    knocks: tuple[Knock, ...] = ()
    every: int = 1  # turn of its mirror makes a scan, the others are left out

    @property
    def period_ns(self) -> int:
        return round(1e9 / self.rate_hz)

    @property
    def beam_ns(self) -> int:
        return round(self.period_ns * self.step_deg / 360.0)


LMS100_50HZ = Laser(LMS100, 541, 50.0, -135.0, 0.5)
UTM30LX_40HZ = Laser(UTM30LX, 1081, 40.0, -135.0, 0.25)


@dataclass(frozen=True)
class Wheels:
    """Odometry's errors: a wrong scale, a wrong track, and noise that grows with the distance."""

    scale: float = 1.0
    turn_scale: float = 1.0
    sigma_m_per_sqrt_m: float = 0.01
    sigma_rad_per_sqrt_m: float = 0.005
    slips: tuple[Slip, ...] = ()


@dataclass(frozen=True)
class Imu:
    """A MEMS gyro and accelerometer, level on the vehicle."""

    gyro_sigma_radps: float = 0.003
    gyro_bias_radps: float = 0.001
    accel_sigma_mps2: float = 0.02
    accel_bias_mps2: float = 0.01
    faults: tuple[GyroFault, ...] = ()


@dataclass(frozen=True)
class Drive:
    """Frames, and the true poses of the base at each scan's first ray, in the frame of the first."""

    frames: list[Frame]
    truth: dict[int, SE2]
    world_first: SE2 = ORIGIN  # the base at the first scan, in the frame of the world

    def at(self, stamp_ns: int) -> SE2:
        """True pose of the base between two scans, in the frame of the first."""
        stamps = sorted(self.truth)
        k = min(max(bisect_right(stamps, stamp_ns), 1), len(stamps) - 1)
        before, after = self.truth[stamps[k - 1]], self.truth[stamps[k]]
        share = (stamp_ns - stamps[k - 1]) / (stamps[k] - stamps[k - 1])
        return before @ SE2.exp(*(share * part for part in (before.inverse() @ after).log()))


@dataclass
class Run:
    """Outputs of a mapper over a drive, and their errors."""

    outputs: list[MapperOutput]
    scan_ms: npt.NDArray[np.float64]
    mapper: Mapper[Any] | MappingSession
    errors: npt.NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 3)))  # forward, left m; rad

    @property
    def position_rmse_m(self) -> float:
        return float(np.sqrt((self.errors[:, :2] ** 2).sum(axis=1).mean()))

    @property
    def heading_rmse_rad(self) -> float:
        return float(np.sqrt((self.errors[:, 2] ** 2).mean()))

    @property
    def end_error(self) -> tuple[float, float]:
        """m and rad at the last scan."""
        return float(np.hypot(*self.errors[-1, :2])), float(abs(self.errors[-1, 2]))


def drive(
    world: World,
    laser: Laser,
    seconds: float,
    seed: int,
    wheels: Wheels | None = None,
    imu: Imu | None = None,
    stand_s: float = 0.5,
) -> Drive:
    """Every beam leaves from where the laser is at its own moment. Same arguments, same frames."""
    return drives(world, laser, seconds, [seed], wheels, imu, stand_s)[0]


def heading_rad(seed: int) -> float:
    """Against the walls, in (-pi, pi): the same for a seed in every world."""
    return float(noise_of(seed, "heading", 0).uniform(-math.pi, math.pi))


def begun_at(world: World, heading_rad: float) -> World:
    """The same drive, begun turned by this and turned back on the spot: the map's axes are those of the
    first scan, so its cells lie at this angle to the walls. People begin to walk when the drive does.
    """
    start = world.drive.start
    turn = plan_drive(SE2(start.x_m, start.y_m, start.theta_rad + heading_rad), [Spin(-heading_rad)])
    nodes = world.drive.nodes.copy()
    nodes[:, THETA] += turn.nodes[-1, THETA] - nodes[0, THETA]
    return replace(
        world,
        people=tuple(person.later(turn.duration_s) for person in world.people),
        movers=tuple(mover.later(turn.duration_s) for mover in world.movers),
        drive=replace(world.drive, nodes=np.vstack([turn.nodes[:-1], nodes]), repeats=False),
    )


def phase_m(seed: int) -> tuple[float, float]:
    """In x and y, 0 to MAX_PHASE_M: the same for a seed in every world."""
    x_m, y_m = noise_of(seed, "phase", 0).uniform(0.0, MAX_PHASE_M, 2)
    return float(x_m), float(y_m)


def begun_beside(world: World, x_m: float, y_m: float) -> World:
    """The same drive, moved by this: the map's cells are those of the first scan, so this is where in its
    cells a wall lies.
    """
    nodes = world.drive.nodes.copy()
    nodes[:, X] += x_m
    nodes[:, Y] += y_m
    return replace(world, drive=replace(world.drive, nodes=nodes))


def drives(
    world: World,
    laser: Laser,
    seconds: float,
    seeds: Sequence[int],
    wheels: Wheels | None = None,
    imu: Imu | None = None,
    stand_s: float = 0.5,
) -> list[Drive]:
    """The same drive once for each seed, as `drive` gives them; the beams are cast only once."""
    ride = Ride(world, 0, stand_s)
    scans_of_seeds = scans(ride, laser, seconds, seeds)
    truth = {frame.stamp_ns: ride.pose(frame.stamp_ns) for frame in scans_of_seeds[0]}
    first = next(iter(truth.values()))
    seen = {stamp_ns: first.inverse() @ pose for stamp_ns, pose in truth.items()}
    made = []
    for seed, laser_scans in zip(seeds, scans_of_seeds, strict=True):
        frames: list[Frame] = list(laser_scans)
        if wheels is not None:
            frames += odometry(ride, wheels, seconds, seed)
        if imu is not None:
            frames += inertial(ride, imu, seconds, seed)
        made.append(Drive(sorted(frames, key=lambda frame: frame.arrived_ns), seen, first))
    return made


def scans(ride: Ride, laser: Laser, seconds: float, seeds: Sequence[int]) -> list[list[LaserScan]]:
    """Those of each seed."""
    source = LaserTruth(ride, laser.name, laser.mounting, laser.model, seeds[0], laser.knocks)
    made: list[list[LaserScan]] = [[] for _ in seeds]
    for stamp_ns in range(0, round(seconds * 1e9), laser.every * laser.period_ns):
        for of_seed, scan in zip(made, scans_at(source, laser, stamp_ns, seeds), strict=True):
            of_seed.append(scan)
    return made


def scans_at(source: LaserTruth, laser: Laser, stamp_ns: int, seeds: Sequence[int]) -> Iterator[LaserScan]:
    """That of each seed."""
    first_rad, step_rad = math.radians(laser.first_deg), math.radians(laser.step_deg)
    view = source.view(Beams(stamp_ns, laser.beam_ns, first_rad, step_rad, laser.beams))
    for seed in seeds:
        yield LaserScan(
            sensor=laser.name,
            stamp_ns=stamp_ns,
            arrived_ns=stamp_ns + laser.beams * laser.beam_ns,
            beam_interval_ns=laser.beam_ns,
            scan_period_ns=laser.period_ns,
            first_angle_rad=first_rad,
            angle_step_rad=step_rad,
            range_min_m=laser.model.range_min_m,
            range_max_m=laser.model.range_max_m,
            range_m=source.measure(view, seed).range_m,
            intensity=NO_INTENSITY,
        )


def odometry(ride: Ride, wheels: Wheels, seconds: float, seed: int) -> list[OdometrySample]:
    stamps_ns = np.arange(0, round(seconds * 1e9), ODOMETRY_NS, dtype=np.int64)
    poses = [SE2(float(x), float(y), float(theta)) for x, y, theta in ride.poses(stamps_ns)]
    noise = noise_of(seed, "wheels", 0)
    samples, believed = [], SE2()
    for k, stamp_ns in enumerate(stamps_ns.tolist()):
        forward, left, turn = (poses[max(k - 1, 0)].inverse() @ poses[k]).log()
        for slip in wheels.slips:
            path_scale, turn_scale = slip.scales(ride.drive_s(stamp_ns))
            forward, left, turn = path_scale * forward, path_scale * left, turn_scale * turn
        root_m = math.sqrt(abs(forward))
        believed = believed @ SE2.exp(
            wheels.scale * forward + wheels.sigma_m_per_sqrt_m * root_m * noise.standard_normal(),
            left,
            wheels.turn_scale * turn + wheels.sigma_rad_per_sqrt_m * root_m * noise.standard_normal(),
        )
        samples.append(
            OdometrySample(
                "base",
                stamp_ns,
                stamp_ns + 2_000_000,
                believed.x_m,
                believed.y_m,
                believed.theta_rad,
                (0.0, 0.0, 0.0),
                (0.0,) * 9,
            )
        )
    return samples


def inertial(ride: Ride, imu: Imu, seconds: float, seed: int) -> list[ImuSample]:
    """Rates and accelerations in base axes, z up, from central differences of the true drive."""
    noise = noise_of(seed, "imu", 0)
    gyro_bias = imu.gyro_bias_radps * noise.standard_normal(3)
    accel_bias = imu.accel_bias_mps2 * noise.standard_normal(3)
    stamps_ns = np.arange(0, round(seconds * 1e9), IMU_NS, dtype=np.int64)
    half_ns = IMU_NS // 2
    before, here, after = (ride.poses(stamps_ns + shift_ns) for shift_ns in (-half_ns, 0, half_ns))
    half_s = half_ns * 1e-9
    rate = np.remainder(after[:, 2] - before[:, 2] + math.pi, 2.0 * math.pi) - math.pi
    rate /= 2.0 * half_s
    accel = (after[:, :2] - 2.0 * here[:, :2] + before[:, :2]) / half_s**2
    c, s = np.cos(here[:, 2]), np.sin(here[:, 2])
    forward, left = c * accel[:, 0] + s * accel[:, 1], -s * accel[:, 0] + c * accel[:, 1]
    samples: list[ImuSample] = []
    for k, stamp_ns in enumerate(stamps_ns.tolist()):
        gyro = gyro_bias + imu.gyro_sigma_radps * noise.standard_normal(3)
        felt = accel_bias + imu.accel_sigma_mps2 * noise.standard_normal(3)
        rate_radps = (float(gyro[0]), float(gyro[1]), float(rate[k] + gyro[2]))
        for fault in imu.faults:
            if fault.from_s <= ride.drive_s(stamp_ns) < fault.to_s:
                rate_radps = (*rate_radps[:2], rate_radps[2] + fault.bias_radps)
                rate_radps = samples[-1].rate_radps if fault.is_frozen and samples else rate_radps
        samples.append(
            ImuSample(
                "imu",
                stamp_ns,
                stamp_ns + 1_000_000,
                rate_radps,
                (float(forward[k] + felt[0]), float(left[k] + felt[1]), float(9.81 + felt[2])),
            )
        )
    return samples


def run(
    config: MappingConfig,
    what: Drive,
    mountings: Mapping[str, SE2] | None = None,
    without_motion: bool = False,
) -> Run:
    """A fresh mapper through a drive. without_motion: sweeps are declared instants, so none is deskewed."""
    frames = what.frames
    if without_motion:
        frames = [replace(f, beam_interval_ns=0) if isinstance(f, LaserScan) else f for f in frames]
    return _through(build_mapper(config, mountings or {"front": FORWARD}), frames, what)


def run_session(config: MappingConfig, what: Drive) -> Run:
    """A drive through a session, as `corridor replay` makes it: what the graph finds comes back half a second
    later. Of a mapper alone, as in `run`, the graph only receives, until it is finished.
    """
    session = MappingSession(lambda: build_mapper(config, {"front": FORWARD}), ["front"])
    return _through(session, what.frames, what)


def _through(mapper: Mapper[Any] | MappingSession, frames: Sequence[Frame], what: Drive) -> Run:
    outputs, took_ms = [], []
    for frame in frames:
        began_ns = time.thread_time_ns()
        output = mapper.process(frame)
        if output is not None:
            took_ms.append((time.thread_time_ns() - began_ns) / 1e6)
            outputs.append(output)
    away = [what.truth[output.stamp_ns].inverse() @ output.pose_map_base for output in outputs]
    errors = np.array([(e.x_m, e.y_m, e.theta_rad) for e in away])
    return Run(outputs, np.array(took_ms), mapper, errors)


def off_walls_m(xy: npt.NDArray[np.float64], walls: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """(N,) from each of (N, 2) places to the nearest of walls [x0, y0, x1, y1]."""
    nearest_m = np.full(len(xy), np.inf)
    for x0, y0, x1, y1 in walls:
        wall, off = np.array([x1 - x0, y1 - y0]), xy - (x0, y0)
        along = np.clip(off @ wall / max(wall @ wall, 1e-12), 0.0, 1.0)
        nearest_m = np.minimum(nearest_m, np.hypot(*(off - along[:, None] * wall).T))
    return nearest_m
