"""Qian et al. 2019 on the simulated library: orthogonal weights against the plain map, closure, points."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any
from unittest.mock import patch

import numpy as np
import numpy.typing as npt

from service.geometry.poses import points_from
from service.mapper.filters.deskew import BeamsConfig
from service.mapper.papers.owolm_eskf import across_walls
from service.mapper.papers.owolm_eskf.orthogonal_map import OrthogonalMap, OrthogonalMapConfig
from service.mapper.profiles import mapping_config
from service.offline.score.score import align
from simulators.worlds.corridors import corridor100
from simulators.worlds.library import library
from tests.papers.library_survey import library_check_points, library_structure
from tests.papers.owolm_pictures import draw_maps, draw_overlay, draw_segments
from tests.papers.recorded import error_row, rescored, scored
from tests.papers.report import Row, Section, seeds_text
from tests.papers.true_poses import true_scans
from tests.simulated import (
    UTM30LX_40HZ,
    Drive,
    Imu,
    Run,
    Wheels,
    begun_beside,
    drive,
    off_walls_m,
    phase_m,
    run,
)

Array = npt.NDArray[np.float64]
FAR_M = 0.05
# Plain maps: every point is blurred alike, as narrowly as those in segments are, as widely as all others
# are, and between.
PLAIN_CELLS = (OrthogonalMapConfig().segment_sigma_cells, 1.5, OrthogonalMapConfig().other_sigma_cells)
ARM_M = (0.10, 0.60)  # part of a wall beside a corner that its place is read from
BESIDE_M = 0.5  # a wall of a corner is looked for so far to each side: other objects there may be taken
PEAK_M = 0.05  # of the strongest wall in it; its place is the mean of what lies so near
LAP_S = library().drive.duration_s + 0.5  # half a second to stand; then one lap
SHOWN_M = (3.0, 13.5, -3.0, 8.0)  # part of the library in the pictures: x0, x1, y0, y1
BARE_S, OFF_M = 40.0, 0.15
TRUE_EVERY = 12  # scans of a drive, 0.3 s: a map at true poses takes one each 0.3 m, as that of a drive does
TURNED_DEG = (10.0, 45.0)
WIDE = (
    "what is hit once hardly counts in a plain map blurred so widely either, and books are hit often in "
    "both: at true poses the bound is missed as well; a wider blur of points in no segment brings it nearer, "
    "and loses scans of csail (section Limits of segments)"
)
BOOKS = (
    "at bookcases the strongest wall is often books, up to 15 cm behind; in the map at true poses the corner "
    "finder is off by as much as the bound allows, which leaves the drive nothing"
)
CLOSES = "the plain map closes as well: what blurs the map costs it little of its pose"


@dataclass(frozen=True)
class Aligned:
    """A map after the best fit of its check points to the true ones (x, y, rotation), as table 1 has it."""

    xy: Array  # (N, 2) m, cells
    likelihood: Array  # (N,)
    residuals: Array  # (18, 2) m, map less truth; NaN where a point was not found

    @property
    def residuals_m(self) -> Array:
        lengths: Array = np.hypot(*self.residuals.T)
        return lengths

    @property
    def far_share(self) -> float:
        return far_share(self.xy, self.likelihood)


@cache
def _rides(seeds: Sequence[int]) -> list[Drive]:
    worlds = [(seed, begun_beside(library(), *phase_m(seed))) for seed in seeds]
    return [drive(world, UTM30LX_40HZ, LAP_S, seed, imu=Imu()) for seed, world in worlds]  # B1 B2


@cache
def _weighed(seeds: Sequence[int]) -> list[Run]:
    return [_mapped(ride) for ride in _rides(seeds)]


def _at_true_poses(ride: Drive, every: int, **local_map: Any) -> tuple[Array, Array]:
    """Cells and likelihoods, as of `occupied`, from the start of the world: no error of a pose is in them."""
    config = OrthogonalMapConfig.model_validate({"levels": 1, "insert_inlier_ratio": 0.0, **local_map})
    made = OrthogonalMap(config)
    for points, match in true_scans(ride, BeamsConfig(), every):
        made.insert(points, match)
    xy, likelihood = made.occupied()
    return xy + np.array([ride.world_first.x_m, ride.world_first.y_m]), likelihood


def _against_plain(seeds: Sequence[int]) -> Section:
    """B28 B29."""
    rides = _rides(seeds)
    weighed = _weighed(seeds)
    maps = [_aligned(ran, ride) for ran, ride in zip(weighed, rides, strict=True)]
    far, closure = [aligned.far_share for aligned in maps], [r.end_error[0] for r in weighed]
    shown = {"weighed": (maps[0].xy, maps[0].likelihood)}
    rows = [Row("share of the map's mass farther than 5 cm from the structure", far, "of 1", "B28")]
    runs_of, far_of = {}, {}
    for cells in PLAIN_CELLS:
        runs_of[cells] = [
            _mapped(ride, {"weigh_segments": False, "other_sigma_cells": cells}) for ride in rides
        ]
        maps_plain = [_aligned(ran, ride) for ran, ride in zip(runs_of[cells], rides, strict=True)]
        far_of[cells] = [aligned.far_share for aligned in maps_plain]
        shown[f"plain, {cells} cells"] = (maps_plain[0].xy, maps_plain[0].likelihood)
        rows.append(Row(f"the same of the plain map, blurred by {cells} cells", far_of[cells], "of 1", "B28"))
    best = min(PLAIN_CELLS, key=lambda cells: float(np.median(far_of[cells])))
    plain = runs_of[best]
    closure_plain = [r.end_error[0] for r in plain]
    true = [far_share(*_at_true_poses(ride, TRUE_EVERY)) for ride in rides]
    true_plain = [
        far_share(*_at_true_poses(ride, TRUE_EVERY, weigh_segments=False, other_sigma_cells=best))
        for ride in rides
    ]
    return Section(
        "Library, one lap of 116 m",
        "UTM-30LX at 40 Hz, IMU at 200 Hz, no odometry, no loop closing (B31). The plain maps are the same "
        "profile without segments, every point blurred alike; the one with the least mass far from the "
        f"structure, that of {best} cells, is the one to compare "
        "with. Maps are aligned with the structure by their check "
        "points. Books up to 15 cm behind their cases' fronts and what is seen behind glass count as "
        "far from the structure.",
        [
            *rows,
            Row(
                "ratio to the best plain map",
                _ratios(far, far_of[best]),
                "times",
                "B28",
                at_most=0.65,
                by_worst=True,
                cause=WIDE,
            ),
            Row("the same ratio of two maps at true poses", _ratios(true, true_plain), "times", "B28"),
            Row("closure", closure, "m", "B29", at_most=0.15, by_worst=True),
            Row("closure of that plain map", closure_plain, "m", "B29"),
            Row(
                "ratio of the two", _ratios(closure, closure_plain), "times", "B29", at_most=0.5, cause=CLOSES
            ),
            Row("position, RMS over the lap", [r.position_rmse_m for r in weighed], "m", "B29"),
            Row("position of that plain map", [r.position_rmse_m for r in plain], "m", "B29"),
        ],
        pictures=[
            draw_maps({k: shown[k] for k in ("weighed", f"plain, {best} cells")}, 0.05, SHOWN_M, seeds[0])
        ],
    )


def _check_points(seeds: Sequence[int]) -> Section:
    """B30 B34."""
    maps = [_aligned(ran, ride) for ran, ride in zip(_weighed(seeds), _rides(seeds), strict=True)]
    true = [_fitted(*_at_true_poses(ride, TRUE_EVERY)) for ride in _rides(seeds)]
    found = [int(np.isfinite(aligned.residuals_m).sum()) for aligned in maps]
    return Section(
        "18 check points",
        "Corners of the hall, the offices, bookcases and the cabinet, looked for in the map up to 50 cm from "
        "their true places: x and y are those of the strongest walls along y and x there, of cells 10 to "
        "60 cm from the corner, weighted by their likelihood squared; that may be another wall than the "
        "corner's. "
        "Then translation and rotation are fitted. "
        "Sides of bookcases are books, not fronts, which is most of points 9 to 16. The table shows seed "
        f"{seeds[0]}.",
        [
            Row("corners found of 18", found, "corners", "B30", at_least=18),
            Row("median residual", _medians_cm(maps), "cm", "B30", at_most=2.85, cause=BOOKS),
            Row("RMS residual", _rms_cm(maps), "cm", "B30", at_most=6.5),
            Row("median residual in a map at true poses", _medians_cm(true), "cm", "B30"),
            Row("RMS residual there", _rms_cm(true), "cm", "B30"),
        ],
        [_table(maps[0].residuals)],
        [draw_overlay(maps[0].xy, maps[0].likelihood, library_structure(), library_check_points(), seeds[0])],
    )


def _limits(seeds: Sequence[int]) -> Section:
    """B21: effect of the limits of segments on the map, at true poses; B23."""
    ride = _rides(seeds)[0]

    def share(**local_map: Any) -> float:
        return far_share(*_at_true_poses(ride, 4, **local_map))

    lines = ["| map | share of the mass farther than 5 cm |", "|---|---|", f"| default | {share():.3f} |"]
    for key, values in {
        "least_points": (10, 40),
        "length_m": (0.5, 1.5, 2.0),
        "gap_m": (0.0, 0.1),
        "width_m": (0.02, 0.06),
    }.items():
        lines += [f"| `{key}: {value}` | {share(segments={key: value}):.3f} |" for value in values]
    for cells in (5.0, 8.0):
        lines.append(f"| `other_sigma_cells: {cells}` | {share(other_sigma_cells=cells):.3f} |")
    for cells in (0.5, 1.5, 3.0, 5.0, 8.0):
        plain = share(weigh_segments=False, other_sigma_cells=cells)
        lines.append(f"| plain, every point blurred by {cells} cells | {plain:.3f} |")
    lost = ["| blur of points in no segment | scans of csail lost | error on csail |", "|---|---|---|"]
    for cells in (OrthogonalMapConfig().other_sigma_cells, 5.0, 8.0):
        on_csail = scored("owolm_eskf", "csail", {"local_map": {"other_sigma_cells": cells}})
        if on_csail is not None:
            lost.append(f"| {cells} cells | {100.0 * on_csail.lost_share:.1f} % | {on_csail.error_m:.3f} m |")
    points, match = next(true_scans(ride, BeamsConfig()))
    xy_m = points_from(np.array([0.0, 0.0, match.motion.pose_odom_base.theta_rad]), points.xy_base)
    local_map = OrthogonalMap(OrthogonalMapConfig())
    picture = draw_segments(xy_m, local_map.segments(xy_m, local_map.gaps(points)))
    return Section(
        "Limits of segments",
        "The map is built at true poses (B21), so that errors of the poses add nothing. A blur of more than "
        "3 cells for points outside all segments reduces their mass further, but in recordings of real "
        "buildings, whose walls are seldom straight for a metre, little structure remains to match to.",
        tables=["\n".join(lines), "\n".join(lost)],
        pictures=[picture],
        ran_on=seeds_text(seeds[:1]),
    )


def _begun_at_an_angle(seeds: Sequence[int]) -> Section:
    """B18 B3: the same library, begun at an angle to its walls."""
    rows = []
    for heading_deg in TURNED_DEG:
        ran = _mapped(drive(library(heading_deg), UTM30LX_40HZ, LAP_S, seeds[0], imu=Imu()))
        found_deg = math.degrees(_map_of(ran).pose_axes_odom.theta_rad)
        away_deg = abs((found_deg - heading_deg + 45.0) % 90.0 - 45.0)
        rows += [
            Row(f"begun at {heading_deg:.0f}°: axes of the map off the walls by", [away_deg], "°", "B18"),
            Row(f"begun at {heading_deg:.0f}°: closure", [ran.end_error[0]], "m", "B18", at_most=0.15),
            Row(f"begun at {heading_deg:.0f}°: position, RMS", [ran.position_rmse_m], "m", "B18"),
        ]
    return Section(
        "Start at an angle to the walls",
        "One lap. The map aligns its axes with the walls.",
        rows,
        ran_on=seeds_text(seeds[:1]),
    )


def _one_motion_source(seeds: Sequence[int]) -> Section:
    """Only wheels, only an IMU, or nothing measures the motion; walls do not constrain the position along."""
    rows = []
    for name, sources in {
        "wheels alone": {"wheels": Wheels(scale=1.01)},
        "an IMU alone": {"imu": Imu()},
        "neither": {},
    }.items():
        runs = [
            _mapped(drive(begun_beside(corridor100(), *phase_m(seed)), UTM30LX_40HZ, BARE_S, seed, **sources))
            for seed in seeds
        ]
        rows += [
            Row(f"{name}: position, RMS", [ran.position_rmse_m for ran in runs], "m", "B29"),
            Row(
                f"{name}: scans that are `ok` and more than {OFF_M} m off",
                [100.0 * _ok_and_off(ran) for ran in runs],
                "%",
                "B29",
                at_most=0.0,
                by_worst=True,
            ),
        ]
    return Section(
        "One source of motion",
        f"{BARE_S:.0f} s down a corridor of 100 m with sunk doors, UTM-30LX at 40 Hz; wheels 1 % off. "
        "The pose along is that of wheels or IMU; dots constrain it only where they agree with these.",
        rows,
    )


def _ok_and_off(ran: Run) -> float:
    away_m = np.hypot(*ran.errors[:, :2].T)
    is_ok = np.array([output.state == "ok" for output in ran.outputs])
    return float((is_ok & (away_m > OFF_M)).mean())


def _shares(seeds: Sequence[int]) -> Section:  # recordings: seeds change nothing
    """Effect of MIN_SHARE and NEAR_AXIS_RAD of across_walls.py."""
    lines = ["| setting | ATE of fgi_s1 | ATE of corridor100d_s1 |", "|---|---|---|"]
    for name, constant, value in (
        ("as it is: 0.2, 15°", "MIN_SHARE", across_walls.MIN_SHARE),
        ("least share 0", "MIN_SHARE", 0.0),
        ("least share 0.1", "MIN_SHARE", 0.1),
        ("least share 0.4", "MIN_SHARE", 0.4),
        ("near an axis: 0°", "NEAR_AXIS_RAD", 0.0),
        ("near an axis: 30°", "NEAR_AXIS_RAD", math.radians(30.0)),
    ):
        with patch.object(across_walls, constant, value):
            found = [rescored("owolm_eskf", world) for world in ("fgi_s1", "corridor100d_s1")]
        errors = " | ".join("" if one is None else f"{one.error_m:.3f} m" for one in found)
        lines.append(f"| {name} | {errors} |")
    return Section(
        "Information of walls by direction",
        "Wheels and IMU, in two corridors of another simulator. Least share: points in no segment "
        "constrain their weaker direction from this share of the stronger on. Near an axis: normals so near "
        "to an axis of the map lie along it.",
        tables=["\n".join(lines)],
        ran_on="recordings",
    )


def _corridors(seeds: Sequence[int]) -> Section:  # recordings: seeds change nothing
    """Where walls do not constrain the position along."""
    rows = []
    for name in ("fgi_s1", "corridor100d_s1", "office300_s1"):
        rows += error_row("B29", "ATE of the recording ", "owolm_eskf", name, at_most=0.15)
    return Section(
        "Straight corridors",
        "Recordings of another simulator with wheels and an IMU: corridors of 38 and 100 m, and an office "
        "beside them. Far points of a corridor's walls are dots of 3 x 3 cells, and the search, which has "
        "no prior, matches the dots of the next scan to them, 0.3 m behind the vehicle. With R computed "
        "from the slopes of those dots the filter follows the search: errors of 9.2 and 27.6 m. If IMU and "
        "odometry both measure the path, R is therefore computed from slopes across walls alone.",
        rows,
        ran_on="recordings",
    )


def _mapped(ride: Drive, local_map: Mapping[str, Any] | None = None) -> Run:
    settings = {"local_map": dict(local_map or {})}
    return run(mapping_config({"profile": "owolm_eskf", "settings": settings}), ride)


def _ratios(a: list[float], b: list[float]) -> list[float]:
    return [x / y for x, y in zip(a, b, strict=True)]


def _map_of(what: Run) -> OrthogonalMap:
    local_map: OrthogonalMap = what.mapper.components.local_map  # type: ignore[attr-defined]
    return local_map


def far_share(xy: Array, likelihood: Array) -> float:
    """Share of the mass of a map that lies farther than FAR_M from the structure."""
    return float(likelihood[off_walls_m(xy, library_structure()) > FAR_M].sum() / likelihood.sum())


def _aligned(what: Run, ride: Drive) -> Aligned:
    xy, likelihood = _map_of(what).occupied()
    return _fitted(xy + np.array([ride.world_first.x_m, ride.world_first.y_m]), likelihood)


def _fitted(xy: Array, likelihood: Array) -> Aligned:
    """A map, from the start of the world, aligned with the true check points."""
    true = library_check_points()
    read = np.array([_corner(xy, likelihood, point) for point in true])
    seen = np.isfinite(read).all(axis=1)
    motion = align(read[seen], true[seen])
    return Aligned(points_from(motion, xy), likelihood, points_from(motion, read) - true)


def _medians_cm(maps: Sequence[Aligned]) -> list[float]:
    return [100.0 * float(np.nanmedian(aligned.residuals_m)) for aligned in maps]


def _rms_cm(maps: Sequence[Aligned]) -> list[float]:
    return [100.0 * math.sqrt(float(np.nanmean(aligned.residuals_m**2))) for aligned in maps]


def _corner(xy: Array, likelihood: Array, point: Array) -> Array:
    """A corner: its y from the strongest wall along x, its x from that along y; NaN where there is none."""
    off = xy - point
    place = np.full(2, np.nan)
    for axis in (0, 1):
        arm = np.abs(off[:, 1 - axis])
        beside = (arm > ARM_M[0]) & (arm < ARM_M[1]) & (np.abs(off[:, axis]) < BESIDE_M)
        across, weight = off[beside, axis], likelihood[beside] ** 2
        if likelihood[beside].sum() > 1.0:
            mass, edges = np.histogram(
                across, round(2.0 * BESIDE_M / PEAK_M), (-BESIDE_M, BESIDE_M), weights=weight
            )
            peak = edges[np.argmax(mass)] + 0.5 * PEAK_M
            near = np.abs(across - peak) < PEAK_M
            place[axis] = point[axis] + np.average(across[near], weights=weight[near])
    return place


def _table(residuals: Array) -> str:
    lines = ["| no. | x cm | y cm | residual cm |", "|---|---|---|---|"]
    for k, (x, y) in enumerate(100.0 * residuals, start=1):
        lines.append(f"| {k} | {x:.1f} | {y:.1f} | {math.hypot(x, y):.1f} |")
    return "\n".join(lines)


SCENARIOS = {
    "library": _against_plain,
    "check_points": _check_points,
    "limits": _limits,
    "angles": _begun_at_an_angle,
    "corridors": _corridors,
    "one_motion_source": _one_motion_source,
    "shares": _shares,
}
