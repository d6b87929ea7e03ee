"""What the vehicle's sensors measure in a world: the truth with each sensor's own errors.

Everything is a function of time and seed. Noise is sampled from a counter-based generator keyed by seed and
sensor and placed by the moment measured, so it does not matter when or how often it is evaluated.
"""

import math
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from service.geometry.se2 import SE2
from simulators.device import Beams, Sweep
from simulators.disturbances import Knock, Slip, rolled
from simulators.trajectory import Floats
from simulators.world import PERSON_REFLECTIVITY, World

BISECTIONS = 7  # find an edge inside a beam's footprint to 1/128 of it
GLASS_COSINE = 0.985  # a pane reflects where the incidence is within 10 deg of perpendicular
CABINET_LOST, CABINET_BEHIND = 0.7, 0.2  # shares of the beams on a glass cabinet; the others see its front
CABINET_DEPTH_M = (0.1, 1.0)  # how far behind its front a beam may come from
MIXED_STEP_M = (0.05, 2.0)  # smaller is no step, larger is distinguished by the pulse
MIXING_SHARE = (0.1, 0.9)  # an edge nearer than this to the footprint's rim leaves no mixed return


class Ride:
    """The vehicle's drive on the host's clock.

    It stands for `stand_s` after `start_ns`, then drives. Before start_ns it stands as well.
    """

    def __init__(self, world: World, start_ns: int, stand_s: float = 2.0) -> None:
        self.world = world
        self.start_ns = start_ns
        self._departure_ns = start_ns + round(stand_s * 1e9)

    def drive_s(self, stamp_ns: int) -> float:
        """Seconds since departure; the clock of drive and people."""
        return (stamp_ns - self._departure_ns) * 1e-9

    def poses(self, stamps_ns: npt.NDArray[np.int64]) -> Floats:
        """(N, 3) x m, y m, theta rad in (-pi, pi] of the base in the frame of its start."""
        time_s: Floats = (stamps_ns - self._departure_ns).astype(np.float64) * 1e-9
        poses = self.world.drive.poses(time_s)
        poses[:, 2] = -np.remainder(math.pi - poses[:, 2], 2.0 * math.pi) + math.pi
        return poses

    def pose(self, stamp_ns: int) -> SE2:
        """Base in the frame of its start."""
        x, y, theta = self.poses(np.array([stamp_ns], dtype=np.int64))[0]
        return SE2(float(x), float(y), float(theta))


def seed_of(seed: int, sensor: str) -> int:
    """A seed of its own for each sensor of a run."""
    return zlib.crc32(f"{seed} {sensor}".encode())


def noise_of(seed: int, sensor: str, moment: int) -> np.random.Generator:
    """A generator of its own for each sensor and moment of a run."""
    key = np.array([seed % 2**64, zlib.crc32(sensor.encode())], dtype=np.uint64)
    counter = np.array([0, 0, moment % 2**64, 0], dtype=np.uint64)
    return np.random.Generator(np.random.Philox(key=key, counter=counter))


@dataclass(frozen=True, slots=True)
class LaserModel:
    """A laser's errors. A wall of reflectivity 0.1 met at a right angle is measured up to tenth_range_m."""

    range_min_m: float
    range_max_m: float
    tenth_range_m: float
    sigma_m: float
    sigma_per_m: float = 0.0
    bias_m: float = 0.0
    quantum_m: float = 0.001
    divergence_rad: float = 0.015  # full width of a beam
    mixed_share: float = 0.4  # of the beams whose footprint straddles a step, those that return from between
    dropout_share: float = 0.0005


# SICK operating instructions LMS1xx, technical data: 18 m at 10 % remission, statistical error 12 mm
# (1 sigma), divergence 15 mrad. It reports echoes down to some centimetres.
LMS100 = LaserModel(0.05, 20.0, tenth_range_m=18.0, sigma_m=0.012)
# LMS5xx HR: 65 m with distances in mm, 40 m at 10 %, 6 mm to 10 m and 14 mm to 30 m; beam 4.7 mrad.
LMS500 = LaserModel(0.2, 65.0, tenth_range_m=40.0, sigma_m=0.005, sigma_per_m=0.0003, divergence_rad=0.0047)
# TiM571, TiM781 data sheets: 0.05 to 25 m, 8 m at 10 %, statistical error 20 mm.
TIM500 = LaserModel(0.05, 25.0, tenth_range_m=8.0, sigma_m=0.02)
# Hokuyo UTM-30LX specification: 0.1 to 30 m, repeated accuracy 10 mm to 10 m and 30 mm beyond.
UTM30LX = LaserModel(0.1, 30.0, tenth_range_m=15.0, sigma_m=0.006, sigma_per_m=0.0007, divergence_rad=0.006)
# UST-10LX data sheet: 0.06 to 30 m, 4 m at 10 %, repeated accuracy 30 mm at most.
UST = LaserModel(0.06, 30.0, tenth_range_m=4.0, sigma_m=0.01, divergence_rad=0.006)
# URG-04LX-UG01 data sheet: 0.02 to 5.6 m, accuracy 30 mm to 1 m and 3 % beyond; a third of it as noise.
URG04LX = LaserModel(0.02, 5.6, tenth_range_m=4.0, sigma_m=0.01, sigma_per_m=0.006)
# IBEO LUX data sheet: 200 m, 50 m at 10 % remission, 4 cm in steps of a centimetre, beam 0.08 deg wide.
IBEO_LUX = LaserModel(0.3, 200.0, tenth_range_m=50.0, sigma_m=0.04, quantum_m=0.01, divergence_rad=0.0014)


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """The noise-free returns of one sweep."""

    moment: int  # ns since the world began; places the noise
    true_m: Floats  # (N,) range of each beam, inf for none
    cosine: Floats  # (N,) of incidence
    reflectivity: Floats  # (N,)
    step_beam: npt.NDArray[np.int64]  # (K,) beams that may return from between both sides of a step
    step_from_m: Floats  # (K,) range of one side
    step_m: Floats  # (K,) from there to the other side
    cabinet_beam: npt.NDArray[np.int64]  # (C,) beams that meet a glass cabinet


class Moving(NamedTuple):
    """What moves during a sweep."""

    discs: Floats  # of World.discs
    faces: Floats  # of World.faces


class LaserTruth:
    """SweepSource: what a laser mounted on the riding vehicle sees."""

    def __init__(
        self,
        ride: Ride,
        sensor: str,
        mounting: SE2,
        model: LaserModel,
        seed: int,
        knocks: Sequence[Knock] = (),
    ) -> None:
        self._ride = ride
        self._sensor = sensor
        self._mounting = mounting
        self._model = model
        self._seed = seed
        self._knocks = knocks

    def sweep(self, beams: Beams) -> Sweep:
        """Each beam is cast from where the vehicle is at its moment."""
        return self.measure(self.view(beams), self._seed)

    def sweep_layers(self, layer_count: int, beams: Beams) -> list[Sweep]:
        """The same walls measured once each layer, with noise of its own."""
        view = self.view(beams)
        return [self.measure(view, seed_of(self._seed, f"layer {k}")) for k in range(layer_count)]

    def view(self, beams: Beams) -> View:
        """The noise-free returns of a sweep; the costly part, and the same for every seed."""
        since_first_s = np.arange(beams.count, dtype=np.float64) * (beams.interval_ns * 1e-9)
        rays = self._rays(beams.first_ray_ns, since_first_s, beams.first_angle_rad, beams.step_rad)
        first_s = self._ride.drive_s(beams.first_ray_ns)
        world, span_s = self._ride.world, max(float(since_first_s[-1]), 1e-3)
        moving = Moving(world.discs(first_s, span_s), world.faces(first_s, span_s, self._sensor))
        rim = np.array([0.0, 0.0, self._model.divergence_rad / 2, 0.0])
        range_m, hit = self._cast(np.vstack([rays, rays + rim, rays - rim]), moving)
        true_m, surface = range_m[: beams.count].copy(), hit[: beams.count]
        cosine, reflectivity = self._surfaces(rays, true_m, surface, moving)
        moment = beams.first_ray_ns - self._ride.start_ns
        on_wall = np.flatnonzero((surface >= 0) & (surface < len(world.segments)))
        cabinet_beam = on_wall[world.cabinet[surface[on_wall]]]
        steps = self._steps(rays, hit.reshape(3, -1), moving)
        return View(moment, true_m, cosine, reflectivity, *steps, cabinet_beam)

    def measure(self, view: View, seed: int) -> Sweep:
        """The sweep of a view, with the noise of that seed."""
        model, beam_count = self._model, len(view.true_m)
        noise = noise_of(seed, self._sensor, view.moment)
        true_m = view.true_m.copy()
        chance, place = noise.random((2, beam_count))
        mixed = chance[view.step_beam] < model.mixed_share
        beam = view.step_beam[mixed]
        true_m[beam] = view.step_from_m[mixed] + place[beam] * view.step_m[mixed]
        lost = self._return_from_cabinets(view, seed, true_m)

        with np.errstate(invalid="ignore"):
            echo = (
                view.reflectivity * view.cosine / 0.1 * (model.tenth_range_m / np.maximum(true_m, 0.01)) ** 2
            )
            measured_m = true_m + model.bias_m
            measured_m += (model.sigma_m + model.sigma_per_m * true_m) * noise.standard_normal(beam_count)
            measured_m = np.round(measured_m / model.quantum_m) * model.quantum_m
            seen = echo * np.exp(0.1 * noise.standard_normal(beam_count)) >= 1.0
            seen &= noise.random(beam_count) >= model.dropout_share
            seen[lost] = False
            seen &= (measured_m >= model.range_min_m) & (measured_m <= model.range_max_m)
        brightness = view.reflectivity * view.cosine * np.exp(0.03 * noise.standard_normal(beam_count))
        return Sweep(
            np.where(seen, measured_m, np.nan).astype(np.float32),
            np.where(seen, np.clip(brightness, 0.0, 1.0), 0.0).astype(np.float32),
        )

    def _return_from_cabinets(self, view: View, seed: int, true_m: Floats) -> npt.NDArray[np.int64]:
        """Move some returns on glass cabinets behind their fronts, in place. Gives the beams lost."""
        noise = noise_of(seed, f"{self._sensor} cabinets", view.moment)
        chance, place = noise.random((2, len(view.cabinet_beam)))
        behind = chance < CABINET_BEHIND
        nearest_m, farthest_m = CABINET_DEPTH_M
        true_m[view.cabinet_beam[behind]] += nearest_m + (farthest_m - nearest_m) * place[behind]
        lost: npt.NDArray[np.int64] = view.cabinet_beam[chance >= 1.0 - CABINET_LOST]
        return lost

    def _cast(self, rays: Floats, moving: Moving) -> tuple[Floats, npt.NDArray[np.int32]]:
        """As World.cast, with S + D + index of a face; a ray that meets glass other than squarely goes
        through it.
        """
        world, discs = self._ride.world, moving.discs
        range_m, hit = world.cast(rays, discs, self._model.range_max_m)
        if world.glass.any():
            glass = np.flatnonzero((hit >= 0) & (hit < len(world.segments)))
            glass = glass[world.glass[hit[glass]]]
            through = glass[_cosine_on(rays[glass], world.segments[hit[glass]]) < GLASS_COSINE]
            range_m[through], hit[through] = world.without_glass.cast(
                rays[through], discs, self._model.range_max_m
            )
        if len(moving.faces):
            face_m, face = _nearest_face(rays, moving.faces)
            nearer = face_m < np.minimum(range_m, self._model.range_max_m)
            range_m[nearer] = face_m[nearer]
            hit[nearer] = len(world.segments) + len(discs) + face[nearer]
        return range_m, hit

    def _rays(
        self, first_ray_ns: int, since_first_s: Floats, first_angle_rad: float, angle_step_rad: float
    ) -> Floats:
        """(N, 4) place, direction and time since the first ray of each beam."""
        poses = self._ride.world.drive.poses(self._ride.drive_s(first_ray_ns) + since_first_s)
        c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
        mounting = self._mounting
        rays = np.empty((len(poses), 4))
        rays[:, 0] = poses[:, 0] + c * mounting.x_m - s * mounting.y_m
        rays[:, 1] = poses[:, 1] + s * mounting.x_m + c * mounting.y_m
        rays[:, 2] = poses[:, 2] + mounting.theta_rad + first_angle_rad
        rays[:, 2] += np.arange(len(poses)) * angle_step_rad
        for knock in self._knocks:
            rays[knock.acts(self._ride.drive_s(first_ray_ns) + since_first_s), 2] += knock.yaw_rad
        rays[:, 3] = since_first_s
        return rays

    def _surfaces(
        self, rays: Floats, range_m: Floats, surface: npt.NDArray[np.int32], moving: Moving
    ) -> tuple[Floats, Floats]:
        """Cosine of incidence and reflectivity where each ray ends; 0 where it does not."""
        world = self._ride.world
        first_disc = len(world.segments)
        first_face = first_disc + len(moving.discs)
        cosine, reflectivity = np.zeros(len(rays)), np.zeros(len(rays))
        wall = (surface >= 0) & (surface < first_disc)
        cosine[wall] = _cosine_on(rays[wall], world.segments[surface[wall]])
        reflectivity[wall] = world.reflectivity[surface[wall]]
        person = (surface >= first_disc) & (surface < first_face)
        if person.any():
            disc, ray = moving.discs[surface[person] - first_disc], rays[person]
            c, s = np.cos(ray[:, 2]), np.sin(ray[:, 2])
            centre = disc[:, :2] + ray[:, 3:] * disc[:, 2:4]
            off = (centre[:, 0] - ray[:, 0]) * s - (centre[:, 1] - ray[:, 1]) * c
            cosine[person] = np.sqrt(np.maximum(0.0, 1.0 - (off / disc[:, 4]) ** 2))
            reflectivity[person] = PERSON_REFLECTIVITY
        on_face = surface >= first_face
        if on_face.any():
            face = moving.faces[surface[on_face] - first_face]
            ends = face[:, :4] + rays[on_face, 3:] * face[:, 4:8]
            cosine[on_face], reflectivity[on_face] = _cosine_on(rays[on_face], ends), face[:, 8]
        return cosine, reflectivity

    def _steps(
        self, rays: Floats, hit: npt.NDArray[np.int32], moving: Moving
    ) -> tuple[npt.NDArray[np.int64], Floats, Floats]:
        """Beams that straddle a step and may return from between both sides; the near ends, the steps, m.

        hit (3, N) is what the middle, the left and the right rim of each beam met. Where the rims met
        different things the edge between is found by bisection: a corner of a room has no step there, a
        door post has.
        """
        edge = np.flatnonzero(hit[1] != hit[2])
        if edge.size == 0:
            return edge, np.empty(0), np.empty(0)
        model = self._model
        half = model.divergence_rad / 2
        left, right = np.full(edge.size, half), np.full(edge.size, -half)
        ray = rays[edge].copy()
        for _ in range(BISECTIONS):
            middle = (left + right) / 2
            ray[:, 2] = rays[edge, 2] + middle
            is_left = self._cast(ray, moving)[1] == hit[1, edge]
            left, right = np.where(is_left, middle, left), np.where(is_left, right, middle)
        ray[:, 2] = rays[edge, 2] + left
        left_m = self._cast(ray, moving)[0]
        ray[:, 2] = rays[edge, 2] + right
        right_m = self._cast(ray, moving)[0]
        with np.errstate(invalid="ignore"):  # both sides may be beyond the range: inf - inf
            step_m = right_m - left_m
            mixed = (np.abs(step_m) > MIXED_STEP_M[0]) & (np.abs(step_m) < MIXED_STEP_M[1])
        share = (half - left) / model.divergence_rad
        mixed &= (share > MIXING_SHARE[0]) & (share < MIXING_SHARE[1])
        return edge[mixed], left_m[mixed], step_m[mixed]


def _cosine_on(rays: Floats, ends: Floats) -> Floats:
    """(N,) cosine of incidence of rays (N, 4) on the segments (N, 4) that they meet."""
    edge = ends[:, 2:] - ends[:, :2]
    across: Floats = np.cos(rays[:, 2]) * edge[:, 1] - np.sin(rays[:, 2]) * edge[:, 0]
    return np.abs(across) / np.hypot(edge[:, 0], edge[:, 1])


def _nearest_face(rays: Floats, faces: Floats) -> tuple[Floats, npt.NDArray[np.int64]]:
    """(N,) distance along rays (N, 4) to the nearest face (F, 9), m, inf for none; which one that is."""
    c, s = np.cos(rays[:, 2:3]), np.sin(rays[:, 2:3])
    ends = faces[None, :, :4] + rays[:, None, 3:] * faces[None, :, 4:8]
    ex, ey = ends[..., 2] - ends[..., 0], ends[..., 3] - ends[..., 1]
    ax, ay = ends[..., 0] - rays[:, :1], ends[..., 1] - rays[:, 1:2]
    with np.errstate(divide="ignore", invalid="ignore"):  # a ray along a face: inf or nan, no hit
        cross = c * ey - s * ex
        along, share = (ax * ey - ay * ex) / cross, (ax * s - ay * c) / cross
    meets = (along >= 0.0) & (share >= 0.0) & (share <= 1.0)
    along = np.where(meets, along, np.inf)
    face = np.argmin(along, axis=1)
    return along[np.arange(len(rays)), face], face


@dataclass(frozen=True, slots=True)
class WheelModel:
    """A differential drive's errors."""

    wheel_base_m: float = 0.235
    scale_sigma: float = 0.005  # each wheel's circumference is off by a share sampled once
    slip_sigma_m: float = 0.002  # random walk of each wheel per square root of a metre rolled
    slips_per_m: float = 0.02  # a wheel spins for a moment
    slip_m: tuple[float, float] = (0.005, 0.02)  # and how far
    slips: tuple[Slip, ...] = ()


CREATE_WHEELS = WheelModel()
SLIP_STEP_S = 0.1
SLIP_BLOCK = 600  # steps sampled at a time


class WheelTruth:
    """WheelSource: how far the wheels have rolled since the world began, slip and scale error included."""

    def __init__(self, ride: Ride, sensor: str, model: WheelModel, seed: int) -> None:
        self._ride = ride
        self._sensor = sensor
        self._model = model
        self._seed = seed
        scales = noise_of(seed, sensor, -1).standard_normal(2)
        self._scale = 1.0 + model.scale_sigma * scales
        self._slip_m = np.zeros((1, 2))  # summed at each step since departure, left and right

    def wheel_travel_m(self, now_ns: int) -> tuple[float, float]:
        """Path length rolled by the left and the right wheel since the world began, m; negative backwards."""
        time_s = max(0.0, self._ride.drive_s(now_ns))
        place = time_s / SLIP_STEP_S
        step = int(place)
        while step + 1 >= len(self._slip_m):
            self._draw_slip()
        slip_m = self._slip_m[step] + (place - step) * (self._slip_m[step + 1] - self._slip_m[step])
        rolled_m = self._rolled_m(np.array([time_s]))[0]
        left_m, right_m = rolled_m * self._scale + slip_m
        return float(left_m), float(right_m)

    def _rolled_m(self, time_s: Floats) -> Floats:
        """(N, 2) travel of the left and the right wheel, before its errors."""
        path_length_m, turned_rad = rolled(self._ride.world.drive, self._model.slips, time_s).T
        half_m = turned_rad * self._model.wheel_base_m / 2
        return np.column_stack([path_length_m - half_m, path_length_m + half_m])

    def _draw_slip(self) -> None:
        """Draw the next block of steps; a block depends on its number only."""
        model = self._model
        first = len(self._slip_m) - 1
        noise = noise_of(self._seed, self._sensor, first // SLIP_BLOCK)
        moments_s = (first + np.arange(SLIP_BLOCK + 1, dtype=np.float64)) * SLIP_STEP_S
        path_length_m = np.abs(np.diff(self._rolled_m(moments_s), axis=0))
        slip_m = model.slip_sigma_m * np.sqrt(path_length_m) * noise.standard_normal(path_length_m.shape)
        spins = noise.random(path_length_m.shape) < model.slips_per_m * path_length_m
        slip_m += spins * noise.uniform(*model.slip_m, path_length_m.shape)
        self._slip_m = np.vstack([self._slip_m, self._slip_m[-1] + np.cumsum(slip_m, axis=0)])
