"""Twenty vehicles whose configs are wrong in everything that `corridor calibrate` estimates.

Run by `python -m tests.accuracy.calibration [SEEDS]`; prints the figures of docs/calibration.md.
"""

import math
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from service.geometry.se2 import SE2
from service.offline.calibrate.calibrate import Calibration, SensorCalibration, calibrate
from service.offline.importing.session_file import write_session
from simulators.truth import LMS100, Ride
from tests.service.offline.calibrate.drives import Vehicle, frames_of, one_laser, to_both_sides
from tests.simulated import Imu, Wheels

SEEDS = 20
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
    by_name = {one.sensor: one for one in done.sensors}
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
        found = _value(by_name[sensor], name)
        off[what] = factor * (found[0] - value)
        sigmas[what] = factor * found[1]
    off["yaw deg"] = math.remainder(off["yaw deg"], 360.0)
    return Trial(wrong, off, sigmas)


def _value(one: SensorCalibration, name: str) -> tuple[float, float]:
    return next((value.value, value.sigma) for value in one.values if value.name == name)


def table(trials: list[Trial]) -> str:
    lines = ["| value | config off by | median error | worst error | reported sigma | bound | within it |"]
    lines.append("|---|---|---|---|---|---|---|")
    for what, aim in AIMS.items():
        name, unit = what.rsplit(" ", 1)
        off = np.abs([one.off[what] for one in trials])
        wrong = np.abs([one.wrong[what] for one in trials]).max()
        sigma = np.median([one.sigmas[what] for one in trials])
        within = int((off <= aim).sum())
        lines.append(
            f"| {name} | up to {wrong:.1f} {unit} | {np.median(off):.3f} {unit} | {off.max():.3f} {unit} | "
            f"{sigma:.3f} {unit} | {aim:g} {unit} | {within} of {len(trials)} |"
        )
    return "\n".join(lines)


def main() -> None:
    seeds = int(sys.argv[1]) if len(sys.argv) > 1 else SEEDS
    trials = []
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(1, seeds + 1):
            trials.append(trial(seed, Path(folder)))
            shown = ", ".join(f"{what} {off:+.3f}" for what, off in trials[-1].off.items())
            print(f"seed {seed}: {shown}", file=sys.stderr, flush=True)
    print(table(trials))


if __name__ == "__main__":
    main()
