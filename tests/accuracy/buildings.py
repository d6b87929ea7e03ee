"""Whole buildings: some in which other mappers failed, a ring driven fast, a mall."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from simulators.trajectory import Limits
from simulators.world import World
from simulators.worlds import WORLDS
from simulators.worlds.corridors import corridor100
from simulators.worlds.mall import mall
from tests.accuracy.driving import Trip, errors_of, ok_and_wrong_row
from tests.papers.report import Row, Section
from tests.simulated import LMS100_50HZ, UTM30LX_40HZ

LMS100_25HZ = replace(LMS100_50HZ, rate_hz=25.0)
FAST_MALL = partial(mall, Limits(speed_mps=3.0, acceleration_mps2=1.0, lateral_mps2=1.2))
MALL_PATH_LENGTH_M = 1500.0

# world, longest ATE in mm
BUILDINGS = (
    ("ring", 10.0),
    ("library", 10.0),
    ("office", 10.0),
    ("floor", 30.0),
    ("corridor100", 40.0),
    ("spins", 10.0),
)
# world, longest ATE in mm: of a laser alone
ALONE: dict[str, tuple[Callable[[], World], float]] = {
    "ring": (WORLDS["ring"], 15.0),
    "library": (WORLDS["library"], 15.0),
    "office": (WORLDS["office"], 15.0),
    "corridor100": (WORLDS["corridor100"], 60.0),
    "corridor100, doors of 10 cm": (partial(corridor100, 0.1), 60.0),
}


def buildings(seeds: Sequence[int]) -> Section:
    rows = []
    for name, bound_mm in BUILDINGS:
        errors = errors_of(Trip(WORLDS[name], LMS100_50HZ), seeds)
        rows += [
            Row(f"{name}: ATE after the finish", errors.finished_mm, "mm", at_most=bound_mm),
            Row(f"{name}: ATE live", errors.ate_mm, "mm"),
            Row(f"{name}: live, as is", errors.as_is_mm, "mm"),
            Row(f"{name}: heading, RMS", errors.heading_deg, "deg"),
        ]
    return Section(
        "Six simulated buildings",
        "One lap each with an LMS-100: 541 beams at 50 Hz, each cast from the pose of its own moment, "
        "mixed pixels, noise of 12 mm. Odometry errs by 1 cm and 0.3 deg per square root of a metre; no "
        "IMU. `floor` is an office of 2000 m2.",
        rows,
    )


def laser_alone(seeds: Sequence[int]) -> Section:
    rows = []
    for name, (world, bound_mm) in ALONE.items():
        errors = errors_of(Trip(world, LMS100_50HZ, wheels=None), seeds)
        rows += [
            Row(f"{name}: ATE after the finish", errors.finished_mm, "mm", at_most=bound_mm),
            Row(f"{name}: live, as is", errors.as_is_mm, "mm"),
            Row(f"{name}: scans lost", errors.lost_percent, "%"),
            ok_and_wrong_row(name, errors.wrong_ok),
        ]
    return Section(
        "A laser alone",
        "One lap each with an LMS-100 as above, without odometry and IMU. The doors of `corridor100` are "
        "sunk by 20 cm, and once by 10: two to five beams hit the side of such a door.",
        rows,
    )


def ring(seeds: Sequence[int]) -> Section:
    rows = []
    for name, laser in (
        ("UTM-30LX, 1081 beams at 40 Hz", UTM30LX_40HZ),
        ("LMS-100, 541 at 50 Hz", LMS100_50HZ),
    ):
        errors = errors_of(Trip(WORLDS["ring"], laser), seeds)
        rows += [
            Row(f"{name}: drift", errors.end_mm, "mm", at_most=6.0),
            Row(f"{name}: drift, every seed", errors.end_mm, "mm", at_most=20.0, by_worst=True),
            Row(f"{name}: heading drift", errors.end_deg, "deg", at_most=0.05),
            Row(f"{name}: as is, RMS", errors.as_is_mm, "mm"),
        ]
    return Section(
        "Drift after a lap of the ring corridor",
        "30 x 20 m, 2 m wide, 1.2 m/s, corners at about 70 deg/s; the error of the last pose.",
        rows,
    )


def big_mall(seeds: Sequence[int]) -> Section:
    world: Callable[[], World] = FAST_MALL
    seconds = seconds_for(world(), MALL_PATH_LENGTH_M)
    errors = errors_of(Trip(world, LMS100_25HZ, seconds), seeds)
    return Section(
        "A mall of 12 000 m2 at 3 m/s",
        f"The first {MALL_PATH_LENGTH_M:.0f} m of a drive through every aisle, {seconds:.0f} s, LMS-100 at "
        "25 Hz, people walking.",
        [
            Row("ATE after the finish", errors.finished_mm, "mm", at_most=50.0),
            Row("live, as is, RMS", errors.as_is_mm, "mm", at_most=100.0),
            Row("live, ATE", errors.ate_mm, "mm"),
            Row("at the end", errors.end_mm, "mm"),
            Row("heading, RMS", errors.heading_deg, "deg"),
        ],
    )


def seconds_for(world: World, path_length_m: float) -> float:
    """Duration of that much of the drive, s."""
    low_s, high_s = 0.0, 2.0 * world.drive.duration_s * max(1.0, path_length_m / world.drive.length_m)
    while high_s - low_s > 0.1:
        middle_s = (low_s + high_s) / 2.0
        if _path_length_m(world, middle_s) < path_length_m:
            low_s = middle_s
        else:
            high_s = middle_s
    return high_s


def _path_length_m(world: World, time_s: float) -> float:
    return float(world.drive.travel(np.array([time_s]))[0, 0])
