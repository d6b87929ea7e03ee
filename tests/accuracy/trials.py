"""Single difficulties: turns, stops, crowds, bad returns, featureless walls, an hour in one place."""

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import numpy.typing as npt

from drivers.frames import OdometrySample
from service.geometry.poses import points_from
from service.geometry.se2 import SE2
from service.outputs import UNKNOWN, TileUpdate
from simulators.world import World
from simulators.worlds import WORLDS
from simulators.worlds.trials import LEAVING_S, glass_hall
from tests.accuracy.driving import Errors, Trip, errors_of
from tests.papers.report import Row, Section
from tests.simulated import LMS100_50HZ, Drive, Imu, Run, Wheels, off_walls_m

GHOST_WALL_M = 0.30  # farther from every wall an occupied cell is no wall
GHOST_PERCENT = 65  # occupied from here on
GHOST_AFTER_S = 20.0
HOUR_S, PARKED_HZ = 3600.0, 5.0


def motion(seeds: Sequence[int]) -> Section:
    rows = []
    for name, seconds in (("spins", None), ("stop_and_go", None), ("crowd", _crowd_s(WORLDS["crowd"]()))):
        errors, ghosts = Errors(), []
        trip = Trip(WORLDS[name], LMS100_50HZ, seconds)
        for seed, (drive, done) in zip(seeds, trip.runs(seeds), strict=True):
            errors.add(drive, done)
            ghosts.append(float(ghost_cells(trip.world_of(seed), drive, done)))
        rows += [
            Row(f"{name}: as is, RMS", errors.as_is_mm, "mm", at_most=10.0),
            Row(f"{name}: scans lost", errors.lost_percent, "%", at_most=0.0, by_worst=True),
        ]
        if name == "crowd":
            rows.append(Row("crowd: ghost cells", ghosts, "cells", at_most=0.0, by_worst=True))
    return Section(
        "Turns, stops and a crowd",
        "spins: turns at 3 rad/s on the spot in four rooms of the office. stop_and_go: a stop every 2 m. "
        "crowd: 1 m/s in a hall with five people who stay within 3 m and then leave. A ghost is a cell "
        "shown as occupied that is more than 0.3 m from every wall and from every place where a person was "
        "in the last 20 s. LMS-100 at 50 Hz, odometry.",
        rows,
    )


def bad_returns(seeds: Sequence[int]) -> Section:
    clean = replace(LMS100_50HZ.model, mixed_share=0.0, dropout_share=0.0)
    office = {
        "clean": clean,
        "range bias of 30 mm": replace(clean, bias_m=0.03),
        "mixed pixels, all beams that straddle a step": replace(clean, mixed_share=1.0),
        "30 % of the beams lost": replace(clean, dropout_share=0.3),
    }
    rows = []
    reference: list[float] = []
    for what, model in office.items():
        errors = errors_of(Trip(WORLDS["office"], replace(LMS100_50HZ, model=model)), seeds)
        reference = reference or errors.as_is_mm
        rows += _against(f"office, {what}", errors.as_is_mm, reference)
    brick = errors_of(Trip(partial(glass_hall, glass=False), LMS100_50HZ), seeds)
    glass = errors_of(Trip(glass_hall, LMS100_50HZ), seeds)
    rows += _against("hall, one side of brick", brick.as_is_mm, brick.as_is_mm)
    rows += _against("the same side of glass", glass.as_is_mm, brick.as_is_mm)
    return Section(
        "Returns that are wrong, missing or behind glass",
        "Each fault alone, compared with the same drive without it (no mixed pixels, no lost beams). RMS "
        "error as is; the bound is twice the error without the fault, for each seed.",
        rows,
    )


def bare_corridor(seeds: Sequence[int]) -> Section:
    rows = []
    for what, imu in (("odometry", None), ("odometry and IMU", Imu())):
        ratios, ends, alone, facts = [], [], [], []
        trip = Trip(WORLDS["featureless"], LMS100_50HZ, 100.0, Wheels(), imu)
        for drive, done in trip.runs(seeds):
            wheels_m = _wheels_end_m(drive)
            ends.append(1e3 * done.end_error[0])
            alone.append(1e3 * wheels_m)
            ratios.append(done.end_error[0] / wheels_m)
            facts.append(100.0 * _reported_share(done))
        rows += [
            Row(f"{what}: error at the end / that of the odometry", ratios, "times", at_most=1.0),
            Row(f"{what}: error at the end", ends, "mm"),
            Row(f"{what}: of the odometry alone", alone, "mm"),
            Row(f"{what}: scans that name the free direction", facts, "%", at_least=95.0),
        ]
    return Section(
        "A bare corridor",
        "100 m between bare walls, both ends out of sight: the scans do not fix the position along the "
        "corridor. Odometry has to carry it, and the state has to name the open direction.",
        rows,
    )


def parked(seeds: Sequence[int]) -> Section:
    laser = replace(LMS100_50HZ, rate_hz=PARKED_HZ)
    trip = Trip(WORLDS["room"], laser, HOUR_S, Wheels())
    ends_mm, ends_deg, worst_mm = [], [], []
    some = int(10 * PARKED_HZ)
    for _, done in trip.runs(seeds):
        parked_errors = done.errors[some:] - done.errors[some : 2 * some].mean(axis=0)
        tail = parked_errors[-some:].mean(axis=0)
        ends_mm.append(1e3 * float(np.hypot(*tail[:2])))
        ends_deg.append(math.degrees(abs(float(tail[2]))))
        worst_mm.append(1e3 * float(np.hypot(*parked_errors[:, :2].T).max()))
    return Section(
        "Parked for an hour",
        f"In the square room, {PARKED_HZ:.0f} scans a second instead of 50, with the mirror speed of that "
        "rate. The vehicle turns to its heading first. Creep is the mean of the last 10 s against the mean "
        "from 10 s to 20 s.",
        [
            Row("creep", ends_mm, "mm", at_most=1.0, digits=2),
            Row("creep of the heading", ends_deg, "deg", at_most=0.01, digits=4),
            Row("farthest single pose", worst_mm, "mm", digits=2),
        ],
    )


def ghost_cells(world: World, drive: Drive, done: Run, lately_s: float = GHOST_AFTER_S) -> int:
    """Cells shown occupied without a wall there, nor a person in the last lately_s."""
    tiles: list[TileUpdate] = done.mapper.changed_tiles()
    places = points_from(np.array(drive.world_first), np.vstack([_occupied(tile) for tile in tiles]))
    places = places[off_walls_m(places, world.segments) >= GHOST_WALL_M]
    end_s = max(drive.truth) * 1e-9
    recent = [
        person.place(float(t))
        for person in world.people
        for t in np.arange(end_s - lately_s, end_s, 0.1)
        if person.from_s <= t < person.to_s
    ]
    near_m = GHOST_WALL_M + 0.25
    return sum(not recent or np.hypot(*(np.array(recent) - at).T).min() >= near_m for at in places)


def _occupied(tile: TileUpdate) -> npt.NDArray[np.float64]:
    """(N, 2) centres of the occupied cells, m, map frame."""
    row, column = np.nonzero((tile.cells >= GHOST_PERCENT) & (tile.cells != UNKNOWN))
    side = tile.cells.shape[0]
    return np.column_stack([tile.ix * side + column + 0.5, tile.iy * side + row + 0.5]) * tile.cell_m


def _against(what: str, errors_mm: list[float], clean_mm: list[float]) -> list[Row]:
    ratios = [error / clean for error, clean in zip(errors_mm, clean_mm, strict=True)]
    bound = None if errors_mm is clean_mm else 2.0
    return [
        Row(f"{what}: as is, RMS", errors_mm, "mm"),
        *([] if bound is None else [Row(f"{what}: against clean", ratios, "times", at_most=bound)]),
    ]


def _wheels_end_m(drive: Drive) -> float:
    """Position error of the odometry alone at the last scan, m."""
    samples = [frame for frame in drive.frames if isinstance(frame, OdometrySample)]
    stamps = np.array([sample.stamp_ns for sample in samples])

    def pose_at(stamp_ns: int) -> SE2:
        sample = samples[int(np.argmin(np.abs(stamps - stamp_ns)))]
        return SE2(sample.x_m, sample.y_m, sample.theta_rad)

    first_ns, last_ns = min(drive.truth), max(drive.truth)
    away = drive.truth[last_ns].inverse() @ (pose_at(first_ns).inverse() @ pose_at(last_ns))
    return math.hypot(away.x_m, away.y_m)


def _reported_share(done: Run) -> float:
    """Of the scans: degraded, with a reason that names the direction."""
    facts = [output.state == "degraded" and "position along" in output.reason for output in done.outputs]
    return float(np.mean(facts))


def _crowd_s(world: World) -> float:
    """Until all people have been gone for GHOST_AFTER_S."""
    return world.drive.duration_s - LEAVING_S
