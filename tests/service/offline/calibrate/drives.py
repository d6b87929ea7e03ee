"""Drives to calibrate by: to both sides through the simulated office, each sensor with errors of its own."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from drivers.frames import Frame
from service.geometry.se2 import SE2
from simulators.trajectory import Follow, Limits, Pause, Spin, plan_drive
from simulators.truth import LaserModel, Ride
from simulators.world import World, make_world
from simulators.worlds.office import LAP, START, office_plan
from tests.simulated import Imu, Laser, Wheels, inertial, odometry, scans

LIMITS = Limits(speed_mps=1.0, acceleration_mps2=0.8, lateral_mps2=0.7, turn_rate_radps=1.2)


def to_both_sides() -> World:
    """The office without people: a lap, then the same path back."""
    back = [*reversed([tuple(point) for point in LAP[:-1]]), (START.x_m, START.y_m)]
    there_and_back = Follow(LAP, corner_radius_m=0.7), Follow(back, corner_radius_m=0.7)
    drive = plan_drive(START, [*there_and_back, Spin(math.pi), Pause(1.0)], LIMITS, repeats=True)
    return make_world("to_both_sides", office_plan(), [], drive)


@dataclass(frozen=True)
class Vehicle:
    """What is true of the sensors, and what their clocks make of it: late_s is added to each stamp."""

    lasers: tuple[Laser, ...]
    wheels: Wheels | None = None
    imu: Imu | None = None
    late_s: tuple[tuple[str, float], ...] = ()


def one_laser(mounting: SE2, model: LaserModel, name: str = "front", beams: int = 541) -> Laser:
    """At 20 Hz over 270 deg."""
    return Laser(model, beams, 20.0, -135.0, 270.0 / (beams - 1), mounting, name)


def frames_of(ride: Ride, vehicle: Vehicle, seconds: float, seed: int) -> list[Frame]:
    """In the order of their arrival."""
    frames: list[Frame] = []
    for laser in vehicle.lasers:
        frames += scans(ride, laser, seconds, [seed])[0]
    if vehicle.wheels is not None:
        frames += odometry(ride, vehicle.wheels, seconds, seed)
    if vehicle.imu is not None:
        frames += inertial(ride, vehicle.imu, seconds, seed)
    return late(frames, dict(vehicle.late_s))


def late(frames: Sequence[Frame], late_s: dict[str, float]) -> list[Frame]:
    """Stamps moved; a frame arrives when it did, or later where its stamp lies behind that."""
    moved: list[Frame] = []
    for frame in frames:
        stamp_ns = frame.stamp_ns + round(late_s.get(frame.sensor, 0.0) * 1e9) + 10**9
        arrived_ns = max(frame.arrived_ns + 10**9 + 60_000_000, stamp_ns)
        moved.append(replace(frame, stamp_ns=stamp_ns, arrived_ns=arrived_ns))
    return sorted(moved, key=lambda frame: (frame.arrived_ns, frame.sensor))
