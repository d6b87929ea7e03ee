"""Alignment of one closed sub-map with another, and the choice of virtual landmarks."""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from pydantic import Field

from drivers.section import Section
from service.geometry import poses as se2
from service.geometry.poses import Floats
from service.geometry.se2 import wrap_angle
from service.kernels.branch_and_bound import MaxPyramid, padding_cells, pool_levels, search_branch_and_bound
from service.kernels.likelihood import LikelihoodField
from service.kernels.surfels import TILE_CELLS
from service.kernels.tiles import NO_TILE, TileIndex
from service.mapper.matchers.field_align import align, information_at, values_at
from service.mapper.matchers.window_search import window_around
from service.mapper.papers.submap_graph.counted_submaps import ClosedSubmap, CountedMap

LEVELS = 6
ON_MAP = 0.3  # least likelihood of an inlier on the other sub-map
CORNER_REACH_M = 0.6  # radius of the neighbours that decide whether a point is a corner


class SubmapMatchConfig(Section):
    """When two sub-maps show the same place, and which points are landmarks."""

    search_cell_m: float = Field(default=0.10, ge=0.02, le=0.5)
    most_points: int = Field(default=400, ge=50)
    align_sigma: float = Field(default=0.5, gt=0.0)
    align_iterations: int = Field(default=30, ge=1, le=200)
    # Inliers over common points.
    least_inlier_ratio: float = Field(default=0.6, gt=0.0, le=1.0)
    least_common: int = Field(default=120, ge=10)  # points on ground that both sub-maps have observed
    common_part: float = Field(default=0.25, gt=0.0, le=1.0)  # of all points, at least
    landmarks: int = Field(default=4, ge=2, le=20)  # K, of each pair of sub-maps
    landmark_probability: float = Field(default=0.95, gt=0.5, lt=1.0)
    landmark_spacing_m: float = Field(default=1.5, gt=0.0)
    landmark_sigma_m: float = Field(default=0.02, gt=0.0)
    match_sigma_m: float = Field(default=0.015, gt=0.0)  # of a match, added to that of the fit:
    match_sigma_rad: float = Field(default=0.004, gt=0.0)  # sub-maps are distorted
    match_covariance_scale: float = Field(default=0.5, gt=0.0)


@dataclass(frozen=True, slots=True, eq=False)
class WallPoints:
    """The occupied cells of a sub-map, in its odom frame.

    xy            (M, 2) float64   m, centres of cells more likely occupied than not
    probability   (M,) float64
    cornerness    (M,) float64     m^2, lesser principal moment of the occupied cells around
    field         likelihood of end points; empty tiles are left out
    seen          (H, W) bool      at search_cell_m: whether a cell was observed
    corner_xy     (2,)             m, lower left corner of seen[0, 0]
    """

    xy: Floats
    probability: Floats
    cornerness: Floats
    field: LikelihoodField
    seen: npt.NDArray[np.bool_]
    corner_xy: Floats
    search_cell_m: float


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """pose (3,) of the frame of the new sub-map in that of the old one, its covariance, and landmarks."""

    pose: Floats
    covariance: Floats
    share: float
    landmarks: Floats  # (K, 2) m, in the frame of the new one


def extract_walls(closed: ClosedSubmap, match: SubmapMatchConfig) -> WallPoints:
    """Count the scans of a closed sub-map again along the best particle's path, and return its walls."""
    config = closed.config
    pool = CountedMap.new_pool(4096)
    counted = CountedMap(pool, config)
    for scan, pose in zip(closed.scans, closed.track, strict=True):
        counted.insert(scan.xy_base.astype(np.float64), np.array(scan.sensor_xy_m), pose)
    hits, passes, field, _touched = pool.arrays
    tiles = np.array(counted.tiles(), np.int64)
    rows, columns, slots = tiles.T
    log_odds = hits[slots].astype(np.float64) * config.weights.hit
    log_odds += passes[slots].astype(np.float64) * config.weights.passed
    tile, r, c = np.nonzero((hits[slots] > 0) & (log_odds > 0.0))
    cell_m = config.cell_m
    xy = np.stack(
        ((columns[tile] * TILE_CELLS + c + 0.5) * cell_m, (rows[tile] * TILE_CELLS + r + 0.5) * cell_m),
        axis=1,
    )
    probability = 1.0 / (1.0 + np.exp(-log_odds[tile, r, c]))
    walled = (field[slots] > 0).any(axis=(1, 2))
    origin = np.array([rows.min(), columns.min()])
    index = np.full(np.array([rows.max(), columns.max()]) - origin + 1, NO_TILE, np.int32)
    index[rows[walled] - origin[0], columns[walled] - origin[1]] = np.arange(np.count_nonzero(walled))
    kept = np.ascontiguousarray(field[slots[walled]], np.float32)
    empty = TileIndex(index, origin, np.empty(0, np.int32), np.array([0, len(kept)]))
    return WallPoints(
        xy,
        probability,
        _cornerness(xy),
        LikelihoodField(empty, kept, cell_m),
        *_seen(hits[slots], passes[slots], rows, columns, cell_m, match.search_cell_m),
        match.search_cell_m,
    )


def find(
    new: WallPoints, old: WallPoints, guess: Floats, reach: tuple[float, float], config: SubmapMatchConfig
) -> Found | None:
    """Align a sub-map with another: an exhaustive search (by branch and bound), then to a fraction of a cell.

    guess   (3,) pose of the new frame in the old one;  reach   m and rad searched to each side of it
    None where they do not show the same place, or too little of it.
    """
    if len(new.xy) < config.least_common or len(old.xy) < config.least_common:
        return None
    middle = new.xy.mean(axis=0)  # rotations about the middle are uncorrelated with shifts
    points = new.xy[:: max(1, len(new.xy) // config.most_points)] - middle
    start = se2.compose(guess, np.array([*middle, 0.0]))
    pose = _search(points, old, start, reach, config)
    weights = np.full(len(points), 1.0 / config.align_sigma**2)
    weak = pose, np.diag([1e-3, 1e-3, 1e-3])
    pose = align(points, weights, weak, old.field, pose, config.align_iterations)
    pose[2] = float(wrap_angle(pose[2]))
    common = is_seen(old, se2.points_from(pose, points))
    count = int(np.count_nonzero(common))
    if count < max(config.common_part * len(points), config.least_common * len(points) / len(new.xy)):
        return None
    share = float(np.mean(values_at(points, pose, old.field)[common, 0] > ON_MAP))
    if share < config.least_inlier_ratio:
        return None
    hessian = information_at(points, weights, pose, old.field)
    covariance = np.asarray(
        config.match_covariance_scale * np.linalg.inv(hessian + 1e-2 * np.eye(3)), np.float64
    )
    shift = se2.compose(pose, np.array([*-middle, 0.0]))
    landmarks = _landmarks(new, old, shift, config)
    if len(landmarks) < 2:
        return None
    return Found(shift, about_origin(covariance, pose, shift), share, landmarks)


def about_origin(covariance: Floats, pose: Floats, shift: Floats) -> Floats:
    """Covariance (old's axes) of the frame's origin, from that of its middle."""
    lever = np.eye(3)
    lever[:2, 2] = -(shift[1] - pose[1]), shift[0] - pose[0]
    moved: Floats = lever @ covariance @ lever.T
    return moved


def _search(
    points: Floats, old: WallPoints, start: Floats, reach: tuple[float, float], config: SubmapMatchConfig
) -> Floats:
    cell_m = config.search_cell_m
    corner = old.xy.min(axis=0) - 2.0 * cell_m
    pad = padding_cells(LEVELS)
    cells = np.floor((old.xy - corner) / cell_m).astype(np.int64)
    width, height = (cells.max(axis=0) + 3).tolist()
    levels = np.zeros((LEVELS, height + pad, width + pad), np.uint8)
    for dy, dx, value in [(r, c, 150) for r in (-1, 0, 1) for c in (-1, 0, 1)] + [(0, 0, 255)]:
        rows, columns = cells[:, 1] + pad + dy, cells[:, 0] + pad + dx
        levels[0, rows, columns] = np.maximum(levels[0, rows, columns], value)
    pool_levels(levels, 0.0)
    pyramid = MaxPyramid(levels, -pad, -pad, 0.0, 0.0, 1.0 / 255.0, cell_m)
    farthest_m = float(np.hypot(*points.T).max())
    window = window_around(start - np.array([*corner, 0.0]), reach, pyramid, cell_m / max(farthest_m, 1.0))
    result = search_branch_and_bound(points, pyramid, window, 0.0)
    found: Floats = result.pose + np.array([*corner, 0.0])
    return found


def _landmarks(new: WallPoints, old: WallPoints, shift: Floats, config: SubmapMatchConfig) -> Floats:
    """The most likely common points, corners first, with a least distance.

    Source: Zhang et al. 2016, eq. 9; of many cells that are equally certain those with most information.
    """
    certain = np.flatnonzero(new.probability > config.landmark_probability)
    both = certain[values_at(new.xy[certain], shift, old.field)[:, 0] > ON_MAP]
    order = both[np.argsort(-new.cornerness[both], kind="stable")]
    chosen: list[Floats] = []
    spacing_m = config.landmark_spacing_m
    for k in order.tolist():
        if all(math.dist(new.xy[k], other) >= spacing_m for other in chosen):
            chosen.append(new.xy[k])
            if len(chosen) == config.landmarks:
                break
    return np.array(chosen).reshape(-1, 2)


def _cornerness(xy: Floats) -> Floats:
    """Lesser principal moment of the points within CORNER_REACH_M of each, by sums over a grid of squares."""
    if not len(xy):
        return np.empty(0)
    square = np.floor((xy - xy.min(axis=0)) / CORNER_REACH_M).astype(np.int64) + 1
    shape = (int(square[:, 0].max()) + 2, int(square[:, 1].max()) + 2)
    local = xy - xy.mean(axis=0)
    terms = np.stack(
        (
            np.ones(len(xy)),
            local[:, 0],
            local[:, 1],
            local[:, 0] ** 2,
            local[:, 0] * local[:, 1],
            local[:, 1] ** 2,
        )
    )
    sums = np.zeros((6, *shape))
    for total, term in zip(sums, terms, strict=True):
        np.add.at(total, (square[:, 0], square[:, 1]), term)
    around = np.zeros_like(sums)
    for dx in (-1, 0, 1):
        for dy in (-1, 0, 1):
            around[:, 1:-1, 1:-1] += sums[:, 1 + dx : shape[0] - 1 + dx, 1 + dy : shape[1] - 1 + dy]
    n, x, y, xx, xy_, yy = around[:, square[:, 0], square[:, 1]]
    a, b, d = xx / n - (x / n) ** 2, xy_ / n - x * y / n**2, yy / n - (y / n) ** 2
    lesser: Floats = 0.5 * (a + d) - np.sqrt(0.25 * (a - d) ** 2 + b**2)
    return lesser


def _seen(
    hits: npt.NDArray[np.generic],
    passes: npt.NDArray[np.generic],
    rows: npt.NDArray[np.int64],
    columns: npt.NDArray[np.int64],
    cell_m: float,
    search_cell_m: float,
) -> tuple[npt.NDArray[np.bool_], Floats]:
    tile, r, c = np.nonzero((hits > 0) | (passes > 0))  # type: ignore[operator]
    x = (columns[tile] * TILE_CELLS + c + 0.5) * cell_m
    y = (rows[tile] * TILE_CELLS + r + 0.5) * cell_m
    corner = np.array([x.min(), y.min()]) - search_cell_m
    i = np.floor((x - corner[0]) / search_cell_m).astype(np.int64)
    j = np.floor((y - corner[1]) / search_cell_m).astype(np.int64)
    seen = np.zeros((int(j.max()) + 2, int(i.max()) + 2), np.bool_)
    seen[j, i] = True
    return seen, corner


def is_seen(walls: WallPoints, xy: Floats) -> npt.NDArray[np.bool_]:
    """Whether a sub-map has observed each point (N, 2) of its frame."""
    cells = np.floor((xy - walls.corner_xy) / walls.search_cell_m).astype(np.int64)
    height, width = walls.seen.shape
    inside = ((cells >= 0) & (cells < (width, height))).all(axis=1)
    found = np.zeros(len(xy), np.bool_)
    found[inside] = walls.seen[cells[inside, 1], cells[inside, 0]]
    return found
