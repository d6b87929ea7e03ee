"""Paper 002 on the simulated library: orthogonal weights against the plain map, closure, check points."""

import math
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from service.mapper.maps.orthogonal_map import OrthogonalMap
from service.mapper.profiles import mapping_config
from simulators.worlds.library import library, library_check_points, library_structure
from tests.papers.report import Row, Section
from tests.simulated import UTM30LX_40HZ, Drive, Imu, Run, drives, run

Array = npt.NDArray[np.float64]
FAR_M = 0.05
PLAIN = {"weigh_segments": False, "other_sigma_cells": 1.5}  # every point weighs the same
ARM_M = (0.10, 0.60)  # part of a wall beside a corner that its place is read from
BESIDE_M = 0.12


def sections(seeds: int) -> Iterable[Section]:
    world = library()
    seconds = world.drive.duration_s + 0.5  # half a second to stand; then one lap
    rides = drives(world, UTM30LX_40HZ, seconds, list(range(1, seeds + 1)), imu=Imu())  # B1 B2
    weighed = [_mapped(ride) for ride in rides]
    plain = [_mapped(ride, PLAIN) for ride in rides]
    far = [_far_share(r) for r in weighed]
    far_plain = [_far_share(r) for r in plain]
    closure, closure_plain = ([r.end_error[0] for r in runs] for runs in (weighed, plain))
    yield Section(
        "Library, one lap of 116 m",
        "UTM-30LX at 40 Hz, IMU at 200 Hz, no odometry, no loop closing (B31). The plain map is the same "
        "profile without segments: every point is blurred by 1.5 cells. Books up to 15 cm behind their "
        "cases' fronts and what is seen behind glass count as far from the structure.",
        [
            Row("B28", "share of the map's mass farther than 5 cm from the structure", far, ""),
            Row("B28", "the same of the plain map", far_plain, ""),
            Row("B28", "ratio of the two", _ratios(far, far_plain), "", at_most=0.6),
            Row("B29", "closure", closure, "m", at_most=0.15, by_worst=True),
            Row("B29", "closure of the plain map", closure_plain, "m"),
            Row("B29", "ratio of the two", _ratios(closure, closure_plain), "", at_most=0.5),
            Row("B29", "position, RMS over the lap", [r.position_rmse_m for r in weighed], "m"),
            Row("B29", "position of the plain map", [r.position_rmse_m for r in plain], "m"),
        ],
    )
    residuals = [_residuals(r) for r in weighed]
    lengths = [np.hypot(*r.T) for r in residuals]
    found = [int(np.isfinite(length).sum()) for length in lengths]
    yield Section(
        "18 check points",
        "Corners read from the map beside their true places: weighted means of both walls, then a fit of "
        "translation and rotation (B30). The table shows the first seed.",
        [
            Row("B30", "corners found of 18", found, "", at_least=18, digits=0),
            Row(
                "B30",
                "median residual",
                [100 * np.nanmedian(d) for d in lengths],
                "cm",
                at_most=2.85,
                digits=2,
            ),
            Row(
                "B30",
                "RMS residual",
                [100 * math.sqrt(np.nanmean(d**2)) for d in lengths],
                "cm",
                at_most=6.5,
                digits=2,
            ),
        ],
        [_table(residuals[0])],
    )


def _mapped(ride: Drive, local_map: Mapping[str, Any] | None = None) -> Run:
    settings = {"local_map": dict(local_map or {})}
    return run(mapping_config({"profile": "owolm_eskf", "settings": settings}), ride)


def _ratios(a: list[float], b: list[float]) -> list[float]:
    return [x / y for x, y in zip(a, b, strict=True)]


def _map_of(what: Run) -> tuple[Array, Array]:
    local_map: OrthogonalMap = what.mapper._stages.local_map  # type: ignore[attr-defined]
    return local_map.occupied()


def _far_share(what: Run) -> float:
    """Share of the mass of the map that lies farther than FAR_M from the structure."""
    xy, mass = _map_of(what)
    nearest_m = np.full(len(xy), np.inf)
    for x0, y0, x1, y1 in library_structure():
        low, high = np.minimum((x0, y0), (x1, y1)) - FAR_M, np.maximum((x0, y0), (x1, y1)) + FAR_M
        near = np.flatnonzero(((xy >= low) & (xy <= high)).all(axis=1))
        way, off = np.array([x1 - x0, y1 - y0]), xy[near] - (x0, y0)
        along = np.clip(off @ way / (way @ way), 0.0, 1.0)
        nearest_m[near] = np.minimum(nearest_m[near], np.hypot(*(off - along[:, None] * way).T))
    return float(mass[nearest_m > FAR_M].sum() / mass.sum())


def _residuals(what: Run) -> Array:
    """(18, 2) m: check points read from the map less the true ones, after the best fit; NaN: not found."""
    xy, mass = _map_of(what)
    true = library_check_points()
    read = np.array([_corner(xy, mass, point) for point in true])
    seen = np.isfinite(read).all(axis=1)
    a, b = read[seen] - read[seen].mean(axis=0), true[seen] - true[seen].mean(axis=0)
    turn = math.atan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum())
    c, s = math.cos(turn), math.sin(turn)
    fitted = (read - read[seen].mean(axis=0)) @ np.array([[c, s], [-s, c]]) + true[seen].mean(axis=0)
    residuals: Array = fitted - true
    return residuals


def _corner(xy: Array, mass: Array, point: Array) -> Array:
    """A corner: its y from the wall along x, its x from the wall along y; NaN where one is not mapped."""
    off = xy - point
    place = np.full(2, np.nan)
    for axis in (0, 1):
        arm = np.abs(off[:, 1 - axis])
        beside = (arm > ARM_M[0]) & (arm < ARM_M[1]) & (np.abs(off[:, axis]) < BESIDE_M)
        if mass[beside].sum() > 1.0:
            place[axis] = point[axis] + np.average(off[beside, axis], weights=mass[beside] ** 2)
    return place


def _table(residuals: Array) -> str:
    lines = ["| no. | x cm | y cm | residual cm |", "|---|---|---|---|"]
    for k, (x, y) in enumerate(100.0 * residuals, start=1):
        lines.append(f"| {k} | {x:.1f} | {y:.1f} | {math.hypot(x, y):.1f} |")
    return "\n".join(lines)
