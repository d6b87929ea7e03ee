"""The log of one cycle of the papers' flow charts: what each box was given, and what it gave (A45, B33)."""

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from types import ModuleType
from typing import Any
from unittest.mock import patch

import numpy as np
import numpy.typing as npt

from drivers.frames import ImuSample, LaserScan
from service.estimator.motion import Prediction
from service.geometry.poses import moved_by
from service.geometry.se2 import SE2
from service.kernels.contours import ALONE, extract_contours
from service.mapper.components import Match, Points
from service.mapper.matchers.field_align import values_at
from service.mapper.papers.contour_lm import contour_matcher
from service.mapper.papers.contour_lm.contour_map import ContourMap
from service.mapper.papers.owolm_eskf import brute_search
from service.mapper.papers.owolm_eskf.orthogonal_map import NO_SEGMENT, OrthogonalMap
from service.mapper.pipeline import Mapper
from service.mapper.profiles import build_mapper, mapping_config
from simulators.worlds.office import office
from tests.papers.contour_maps import grid, read
from tests.papers.pictures import draw_likelihood, plt, save
from tests.papers.report import Section, seeds_text
from tests.simulated import (
    FORWARD,
    LMS100_50HZ,
    UTM30LX_40HZ,
    Drive,
    Imu,
    Laser,
    begun_beside,
    drive,
    phase_m,
)

Array = npt.NDArray[np.float64]
Boxes = list[tuple[str, str, str]]  # box, what happened, error against the truth
DRIVEN_S = 6.0  # through the first corner of the office
VIEW_M = 4.0  # half a side of the pictures
CELL_M = 0.025
CHANGED = 0.01  # of likelihood: a cell that a scan raised or lowered by less is not shown
CONTOUR, OWOLM = "A45", "B33"


@dataclass(frozen=True)
class Call:
    """One call of a part: what it was given as it was then, and what it gave."""

    given: tuple[Any, ...]
    changed: tuple[Any, ...]  # the same arguments afterwards
    gave: Any


@contextmanager
def listening(module: ModuleType, name: str) -> Iterator[list[Call]]:
    """Every call that a module makes of something it imported."""
    real: Callable[..., Any] = getattr(module, name)
    heard: list[Call] = []

    def tell(*given: Any) -> Any:
        before = kept(given)
        gave = real(*given)
        heard.append(Call(before, kept(given), gave))
        return gave

    def kept(arguments: tuple[Any, ...]) -> tuple[Any, ...]:
        return tuple(one.copy() if isinstance(one, np.ndarray) else one for one in arguments)

    with patch.object(module, name, tell):
        yield heard


@dataclass
class Cycle:
    """A mapper that has been driven up to a scan, and that scan's way through it."""

    mapper: Mapper[Any]
    scan: LaserScan
    truth: SE2
    imu: list[ImuSample]  # since the scan before
    predicted: Prediction
    points: Points  # as deskewed with the prediction

    @property
    def local_map(self) -> Any:
        return self.mapper.components.local_map

    def match(self) -> Match:
        return self.mapper.components.matcher.match(self.points, self.predicted, self.local_map)

    def off(self, pose: SE2 | Array) -> str:
        """How far a pose is from the true one."""
        at = pose if isinstance(pose, SE2) else SE2(*pose.tolist())
        away = self.truth.inverse() @ at
        return (
            f"{1000.0 * away.x_m:+.1f} mm forward, {1000.0 * away.y_m:+.1f} mm left, "
            f"{math.degrees(away.theta_rad):+.3f}°"
        )


def cycles_from_a_corner(profile: str, what: Drive) -> Iterator[Cycle]:
    """From the scan on at which the vehicle turns fastest; who takes one matches and inserts it."""
    scans = [frame for frame in what.frames if isinstance(frame, LaserScan)]
    heading = np.unwrap([what.truth[scan.stamp_ns].theta_rad for scan in scans])
    chosen = scans[int(np.argmax(np.abs(np.gradient(heading))[:-1]))]
    mapper = build_mapper(mapping_config({"profile": profile}), {"front": FORWARD})
    components = mapper.components
    imu: list[ImuSample] = []
    for frame in what.frames:
        if not isinstance(frame, LaserScan) or frame.stamp_ns < chosen.stamp_ns:
            mapper.process(frame)
            imu = [*imu, frame] if isinstance(frame, ImuSample) else []
            continue
        predicted = components.motion_model.predict(frame.stamp_ns)
        points = components.deskew(frame, predicted, frame.stamp_ns)
        yield Cycle(mapper, frame, what.truth[frame.stamp_ns], imu, predicted, points)
        imu = []


def twist_reported(twist: Sequence[float]) -> str:
    return f"{twist[0]:.3f} m/s forward, {twist[1]:+.3f} m/s left, {math.degrees(twist[2]):+.2f} °/s"


def sigmas_reported(covariance: Array) -> str:
    x, y, theta = np.sqrt(np.diag(covariance))
    return f"{1000.0 * x:.1f} mm forward, {1000.0 * y:.1f} mm left, {math.degrees(theta):.3f}°"


def log_of(boxes: Boxes) -> str:
    lines = ["| box | what happened | error against the truth |", "|---|---|---|"]
    return "\n".join([*lines, *(f"| {box} | {what} | {error} |" for box, what, error in boxes)])


def ride(laser: Laser, seed: int, imu: Imu | None = None) -> Drive:
    return drive(begun_beside(office(), *phase_m(seed)), laser, DRIVEN_S, seed, imu=imu)


def contour_cycle(seeds: Sequence[int]) -> Section:
    """A45."""
    cycle = next(cycles_from_a_corner("contour_lm", ride(LMS100_50HZ, seeds[0])))
    local_map: ContourMap = cycle.local_map
    scan, points, predicted = cycle.scan, cycle.points, cycle.predicted
    beside = grid(around(cycle.truth), CELL_M)
    before = read(local_map, beside)[:, 0]
    with (
        listening(contour_matcher, "search_exhaustive") as searches,
        listening(contour_matcher, "align_level") as levels,
    ):
        match = cycle.match()
    contour = np.empty(len(points.xy_base), np.int32)
    limits = local_map._config.contours
    extract_contours(match.points.xy_base, limits.longest_step_m, limits.most_ratio, contour)
    boxes = [
        (
            "previous map",
            f"{local_map.tile_count} tiles on {local_map.level_count} levels; "
            f"{int((before > CHANGED).sum())} cells of the picture are likelier than {CHANGED}",
            "",
        ),
        ("scan", f"{len(points.xy_base)} of {len(scan.range_m)} beams returned between 0.5 and 20 m", ""),
        (
            "velocity estimate",
            f"that of the scan before: {twist_reported(predicted.twist_base)}; the pose follows",
            cycle.off(predicted.pose_odom_base),
        ),
        (
            "scan, deskewed",
            f"its points moved by up to {1000.0 * farthest(points.xy_base, points.xy_raw):.0f} mm",
            "",
        ),
    ]
    if not searches:
        boxes.append(("rough search, coarsest level", "none: the prediction is surer than half a cell", ""))
    for call in searches:
        window, (found, sums) = call.given[2], call.gave
        boxes.append(
            (
                "rough search, coarsest level",
                f"{sums.size} candidates, {2 * window.half_x + 1} x {2 * window.half_y + 1} cells and "
                f"{2 * window.half_theta + 1} headings: {found.score:.3f} at the best, "
                f"{mean_at_centre(sums, call.given[0]):.3f} at the prediction",
                cycle.off(found.pose),
            )
        )
    for number, call in zip(reversed(range(local_map.level_count)), levels, strict=True):
        pose, twist = call.changed[-3], call.changed[-2]
        learns = "; speed " + twist_reported(twist) if number == 0 else ""
        boxes.append(
            (
                f"optimise, cells of {100.0 * call.given[7].cell_m:g} cm",
                f"moved by {1000.0 * math.dist(pose[:2], call.given[-3][:2]):.1f} mm and "
                f"{math.degrees(abs(pose[2] - call.given[-3][2])):.3f}°{learns}",
                cycle.off(pose),
            )
        )
    motion = cycle.mapper.components.motion_model.correct(match.measured)
    moved = farthest(match.points.xy_base, points.xy_base)
    change = local_map.insert(match.points, match._replace(motion=motion))
    after = read(local_map, beside)[:, 0]
    raised, lowered = int((after > before + CHANGED).sum()), int((after < before - CHANGED).sum())
    boxes += [
        (
            "transformed scan",
            f"deskewed anew, {1000.0 * moved:.1f} mm at most; {match.inlier_ratio:.0%} lies on the map; "
            f"known to {sigmas_reported(motion.covariance)}",
            cycle.off(motion.pose_odom_base),
        ),
        (
            "scan map",
            f"{contour.max() + 1} contours of {int((contour != ALONE).sum())} points; "
            f"{int((contour == ALONE).sum())} points in none",
            "",
        ),
        (
            "update",
            f"{'learned' if change.is_keyframe else 'not learned'}; of the cells of the picture {raised} "
            f"rose and {lowered} fell by more than {CHANGED}",
            "",
        ),
    ]
    picture = draw_cycle(
        "one-cycle-contour.png",
        "One cycle of contour_lm: the previous map with the scan at the predicted pose, the next map with "
        f"the scan at the matched pose, and increased (red) and decreased (blue) "
        f"cells; m, seed {seeds[0]} ({CONTOUR})",
        cycle,
        match,
        beside,
        (before, after),
    )
    return Section(
        "Contours, optimisation with the speed inside, learning: `contour_lm`",
        "The simulated office, LMS100 at 50 Hz, laser alone; the scan at which the vehicle turns fastest. "
        "Boxes as in the flow chart of Li et al. 2016 (A45).",
        tables=[log_of(boxes)],
        pictures=[picture],
        ran_on=seeds_text(seeds[:1]),
    )


def owolm_cycle(seeds: Sequence[int]) -> Section:
    """B33. The first scan from the corner on that is inserted: most lie too near the one before."""
    cycles = cycles_from_a_corner("owolm_eskf", ride(UTM30LX_40HZ, seeds[0], Imu()))
    boxes, picture = next(made for cycle in cycles if (made := owolm_boxes(cycle, seeds[0])) is not None)
    return Section(
        "Mechanisation, search down the pyramid, fusion: `owolm_eskf`",
        "The same corner, UTM-30LX at 40 Hz and an IMU at 200 Hz; the first scan there that is inserted. "
        "Boxes as in the flow chart of Qian et al. 2019 (B33).",
        tables=[log_of(boxes)],
        pictures=[picture],
        ran_on=seeds_text(seeds[:1]),
    )


def owolm_boxes(cycle: Cycle, seed: int) -> tuple[Boxes, tuple[str, str]] | None:
    """The boxes and the picture of a scan that is inserted; None for one that is not."""
    local_map: OrthogonalMap = cycle.local_map
    points, predicted = cycle.points, cycle.predicted
    beside = grid(around(cycle.truth), CELL_M)
    before = read_orthogonal(local_map, beside)
    with (
        listening(brute_search, "search_exhaustive") as searches,
        listening(brute_search, "align") as climbs,
    ):
        match = cycle.match()
    axes = local_map.pose_axes_odom.inverse()

    def in_odom(pose: Array) -> SE2:
        return axes @ SE2(*pose.tolist())

    boxes = [
        (
            "mechanisation, prediction",
            f"{len(cycle.imu)} IMU samples in {1000.0 * predicted.elapsed_s:.0f} ms; "
            f"{twist_reported(predicted.twist_base)}; known to {sigmas_reported(predicted.local_covariance)}",
            cycle.off(predicted.pose_odom_base),
        ),
        (
            "scan, deskewed",
            f"{len(points.xy_base)} points, moved by up to "
            f"{1000.0 * farthest(points.xy_base, points.xy_raw):.0f} mm",
            "",
        ),
    ]
    for call in searches:
        layer, window, (found, sums) = call.given[1], call.given[2], call.gave
        boxes.append(
            (
                f"search, cells of {100.0 * layer.cell_m:g} cm",
                f"{sums.size} candidates, {2 * window.half_x + 1} x {2 * window.half_y + 1} cells and "
                f"{2 * window.half_theta + 1} headings of {math.degrees(window.theta_step_rad):.2f}°: "
                f"{found.score:.3f} at the best, {mean_at_centre(sums, call.given[0]) * layer.scale:.3f} in "
                "the middle",
                cycle.off(in_odom(found.pose)),
            )
        )
    for call in climbs:
        boxes.append(
            ("uphill between the cells", f"{len(call.given[0])} points", cycle.off(in_odom(call.gave)))
        )
    assert match.measured is not None
    measured = match.measured
    motion = cycle.mapper.components.motion_model.correct(measured)
    innovation = predicted.pose_odom_base.inverse() @ measured.pose_odom_base
    taken = predicted.pose_odom_base.inverse() @ motion.pose_odom_base
    gap_m = local_map.gaps(points)
    segment = local_map.segments(
        moved_by(local_map.pose_axes_odom @ motion.pose_odom_base, points.xy_base), gap_m
    )
    straight = int((segment != NO_SEGMENT).any(axis=1).sum())
    boxes += [
        (
            "fusion",
            f"the scan alone is known to {sigmas_reported(measured.covariance)}; of the "
            f"{1000.0 * math.hypot(innovation.x_m, innovation.y_m):.1f} mm and "
            f"{math.degrees(abs(innovation.theta_rad)):.3f}° that it says the filter takes "
            f"{1000.0 * math.hypot(taken.x_m, taken.y_m):.1f} mm and "
            f"{math.degrees(abs(taken.theta_rad)):.3f}°; then, by walls alone, "
            f"{sigmas_reported(motion.covariance)}",
            cycle.off(motion.pose_odom_base),
        ),
        (
            "orthogonal segments",
            f"{straight} of {len(points.xy_base)} points lie in {len(np.unique(segment)) - 1} segments",
            "",
        ),
    ]
    if not local_map.insert(match.points, match._replace(motion=motion)).is_keyframe:
        return None
    after = read_orthogonal(local_map, beside)
    raised = int((after > before + CHANGED).sum())
    boxes.append(
        ("update", f"inserted; of the cells of the picture {raised} rose by more than {CHANGED}", "")
    )
    picture = draw_cycle(
        "one-cycle-owolm.png",
        "One cycle of owolm_eskf: the previous map with the scan at the predicted pose, the next map with "
        f"the scan at the matched pose, and increased cells (red); m, seed {seed} ({OWOLM})",
        cycle,
        match,
        beside,
        (before, after),
    )
    return boxes, picture


def around(pose: SE2) -> tuple[float, float, float, float]:
    """x0, x1, y0, y1 in m, whole cells."""
    x, y = (round(at / CELL_M) * CELL_M for at in (pose.x_m, pose.y_m))
    return x - VIEW_M, x + VIEW_M, y - VIEW_M, y + VIEW_M


def farthest(xy: Array, others: Array) -> float:
    """m: how far the same point (N, 2) lies from itself at most."""
    return float(np.hypot(*(xy - others).T).max())


def mean_at_centre(sums: npt.NDArray[np.float32], xy: Array) -> float:
    k, j, i = (size // 2 for size in sums.shape)
    return float(sums[k, j, i]) / len(xy)


def read_orthogonal(local_map: OrthogonalMap, xy: Array) -> Array:
    """(N,) likelihood between the cells of the finest level, at places in odom."""
    at = local_map.pose_axes_odom
    pose = np.array(at)
    likely: Array = values_at(np.ascontiguousarray(xy), pose, local_map.field())[:, 0]
    return likely


def draw_cycle(
    name: str, caption: str, cycle: Cycle, match: Match, beside: Array, maps: tuple[Array, Array]
) -> tuple[str, str]:
    window = around(cycle.truth)
    figure, panels = plt.subplots(1, 3, figsize=(9.6, 3.4), dpi=90, sharey=True)
    aligned = (
        ("previous map, scan as predicted", maps[0], cycle.points, cycle.predicted.pose_odom_base),
        ("map after, scan as matched", maps[1], match.points, match.motion.pose_odom_base),
    )
    for panel, (title, likelihood, points, pose) in zip(panels, aligned, strict=False):
        draw_likelihood(panel, beside, likelihood, CELL_M, window)
        panel.plot(*moved_by(pose, points.xy_base).T, ".", color="tab:red", ms=1.5)
        panel.plot(pose.x_m, pose.y_m, "^", color="tab:green", ms=6)
        panel.set_title(title, fontsize=8)
    change, _, _ = np.histogram2d(
        beside[:, 1],
        beside[:, 0],
        (round(2 * VIEW_M / CELL_M),) * 2,
        (window[2:], window[:2]),
        weights=maps[1] - maps[0],
    )
    panels[2].imshow(change, cmap="bwr", vmin=-0.3, vmax=0.3, origin="lower", extent=window)
    panels[2].set_title("what changed", fontsize=8)
    for panel in panels:
        panel.set_xlim(*window[:2])
        panel.set_ylim(*window[2:])
        panel.tick_params(labelsize=7)
    return save(figure, name, caption)


SCENARIOS = {"contour": contour_cycle, "owolm": owolm_cycle}
