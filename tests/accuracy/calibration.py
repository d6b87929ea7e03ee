"""Vehicles whose configs are wrong in everything that `corridor calibrate` estimates."""

import math
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from service.geometry.se2 import SE2
from service.offline.calibrate.calibrate import Calibration, calibrate
from service.offline.importing.session_file import write_session
from simulators.truth import LMS100, Ride
from tests.papers.report import Row, Section
from tests.service.offline.calibrate.drives import Vehicle, frames_of, one_laser, to_both_sides
from tests.simulated import Imu, Wheels

AIMS = {
    "yaw deg": 0.1,
    "x mm": 10.0,
    "y mm": 10.0,
    "scale %": 0.2,
    "turn scale %": 0.2,
    "base ms": 1.0,
    "imu ms": 1.0,
}
CONFIG = """\
vehicle: veh1
sensors:
  front: {{type: sick_lms100, host: 10.0.0.1, mounting: {{x_m: {x:.4f}, y_m: {y:.4f}, yaw_deg: {yaw:.3f}}}}}
  imu: {{type: xsens_mtig, device: /dev/corridor/xsens}}
  base: {{type: irobot_create, device: /dev/corridor/create}}
recording: {{directory: sessions}}
map: {{directory: maps}}
"""


@dataclass(frozen=True)
class Trial:
    wrong: dict[str, float]  # how far off the config was
    off: dict[str, float]  # how far off the calibration is
    sigmas: dict[str, float]  # what it says itself


def trial(seed: int, folder: Path) -> Trial:
    dice = np.random.default_rng(seed)
    true = SE2(*dice.uniform((-0.3, -0.2), (0.4, 0.2)), math.radians(dice.uniform(-180.0, 180.0)))
    wrong = {
        "x mm": dice.uniform(-100, 100),
        "y mm": dice.uniform(-100, 100),
        "yaw deg": dice.uniform(-5, 5),
        "scale %": dice.uniform(-5, 5),
        "turn scale %": dice.uniform(-5, 5),
        "base ms": dice.uniform(-20, 20),
        "imu ms": dice.uniform(-10, 10),
    }
    scale, turn_scale = 1.0 + wrong["scale %"] / 100.0, 1.0 + wrong["turn scale %"] / 100.0
    vehicle = Vehicle(
        lasers=(one_laser(true, LMS100),),
        wheels=Wheels(1.0 / scale, 1.0 / turn_scale),
        imu=Imu(),
        late_s=(("base", 1e-3 * wrong["base ms"]), ("imu", 1e-3 * wrong["imu ms"])),
    )
    world = to_both_sides()
    frames = frames_of(Ride(world, 0, 1.0), vehicle, world.drive.duration_s, seed)
    believed = {
        "x": true.x_m + 1e-3 * wrong["x mm"],
        "y": true.y_m + 1e-3 * wrong["y mm"],
        "yaw": math.degrees(true.theta_rad) + wrong["yaw deg"],
    }
    session = folder / f"{seed}.mcap"
    write_session(session, frames, {}, {}, log_times=True)
    config = folder / f"{seed}.yaml"
    config.write_text(CONFIG.format(**believed))
    done = calibrate([session], config)
    session.unlink()
    return _judge(done, true, scale, turn_scale, wrong)


def _judge(done: Calibration, true: SE2, scale: float, turn_scale: float, wrong: dict[str, float]) -> Trial:
    found = {(one.sensor, value.name): value for one in done.sensors for value in one.values}
    truth = {
        "x mm": ("front", "x", true.x_m, 1e3),
        "y mm": ("front", "y", true.y_m, 1e3),
        "yaw deg": ("front", "yaw", math.degrees(true.theta_rad), 1.0),
        "scale %": ("base", "scale", 100.0 * scale, 1.0),
        "turn scale %": ("base", "turn scale", 100.0 * turn_scale, 1.0),
        "base ms": ("base", "stamps late by", wrong["base ms"], 1.0),
        "imu ms": ("imu", "stamps late by", wrong["imu ms"], 1.0),
    }
    off, sigmas = {}, {}
    for what, (sensor, name, value, factor) in truth.items():
        off[what] = factor * (found[sensor, name].value - value)
        sigmas[what] = factor * found[sensor, name].sigma
    off["yaw deg"] = math.remainder(off["yaw deg"], 360.0)
    return Trial(wrong, off, sigmas)


def calibration(seeds: Sequence[int]) -> Section:
    with tempfile.TemporaryDirectory() as folder:
        trials = [trial(seed, Path(folder)) for seed in seeds]
    rows = []
    for what, aim in AIMS.items():
        name, unit = what.rsplit(" ", 1)
        off = [abs(one.off[what]) for one in trials]
        rows += [
            Row("", f"{name}: error", off, unit, at_most=aim),
            Row("", f"{name}: reported sigma", [one.sigmas[what] for one in trials], unit),
            Row(
                "",
                f"{name}: within {aim:g} {unit}",
                [float(np.sum(np.array(off) <= aim))],
                "vehicles",
                digits=0,
            ),
            Row("", f"{name}: config off by", [abs(one.wrong[what]) for one in trials], unit, digits=1),
        ]
    return Section(
        "Vehicles whose configs are wrong",
        "A laser mounted anywhere, wheels, an IMU and their stamps, each wrong in the config; one drive that "
        "turns to both sides, calibrated by `corridor calibrate`.",
        rows,
    )
