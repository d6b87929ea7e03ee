"""Walls that a scan sees, and posts: round objects, whose centre is the same from all sides."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from service.kernels.normals import ROUND_OBJECT_M
from service.kernels.posts import find_posts
from service.kernels.range_bias import walls_of_scan
from service.kernels.rays import BEHIND_M
from service.mapper.components import Points

Matrix = npt.NDArray[np.float64]

CENTROID = math.pi / 4.0  # in radii: distance of the centroid of the visible points in front of the centre
ROUND_M = 0.02  # deviation of a post from a circle


@dataclass(frozen=True, slots=True, eq=False)
class Posts:
    """M posts of a scan, as points of it.

    xy_raw, xy_base   (M, 2) m, their centres, as those of the points
    beam_time_s       (M,) of the middle beam of each
    beam              (M,) int32
    point             (M,) index of that beam's point
    variance_m2       (M,) of the centre, in each direction
    is_on_post        (N,) points of the scan on a post: their normals are those of chords
    """

    xy_raw: Matrix
    xy_base: Matrix
    beam_time_s: Matrix
    beam: npt.NDArray[np.int32]
    point: npt.NDArray[np.int64]
    variance_m2: Matrix
    is_on_post: npt.NDArray[np.bool_]

    def normals(self, heading_rad: float, weight: Matrix) -> Matrix:
        """(2 M, 3) two normals of each post, along the axes of the map, in base axes, with its weight."""
        c, s = math.cos(heading_rad), math.sin(heading_rad)
        normals = np.empty((2 * len(self.point), 3))
        normals[0::2, 0], normals[0::2, 1] = c, -s
        normals[1::2, 0], normals[1::2, 1] = s, c
        normals[:, 2] = np.repeat(weight, 2)
        return normals


def posts_of(points: Points) -> Posts:
    """The posts that a scan sees completely.

    A post is a run of consecutive points, at most ROUND_OBJECT_M wide, with a farther background on both
    sides. Half its width is its radius. Returns missing by chance do not end a run.
    """
    sensor = points.sensor_xy_m
    span, spacing_m, _ = find_posts(
        points.xy_raw,
        points.beam,
        points.usual_gap,
        len(points.scan.range_m),
        points.spacing_rad,
        sensor,
        BEHIND_M,
        ROUND_OBJECT_M,
    )
    begin, end = span.T
    is_on_post = np.zeros(len(points.xy_raw), np.bool_)
    for first, after in span.tolist():
        is_on_post[first:after] = True
    of_each = (end - begin).astype(np.float64)
    middle = (begin + end - 1) // 2
    total = np.concatenate((np.zeros((1, 2)), np.cumsum(points.xy_raw, axis=0)))
    centroid = (total[end] - total[begin]) / of_each[:, None]
    ahead = centroid - sensor
    ahead /= np.hypot(ahead[:, 0], ahead[:, 1])[:, None]
    width_m = ((points.beam[end - 1] - points.beam[begin]) / points.usual_gap + 1.0) * spacing_m
    middle_raw = centroid + ahead * (CENTROID * 0.5 * width_m)[:, None]
    sigma2 = points.range_sigma_m**2
    variance_m2 = sigma2 + spacing_m**2 / 12.0 + ROUND_M**2
    shift = points.xy_base[middle] - points.xy_raw[middle]
    return Posts(
        middle_raw,
        middle_raw + shift,
        points.beam_time_s[middle],
        points.beam[middle],
        middle,
        variance_m2,
        is_on_post,
    )


class SeenWalls(NamedTuple):
    """Walls of a scan.

    points      without the bias of its ranges
    on_walls    the same, moved along their walls onto their beams
    normals     (N, 3) from estimate_normals
    has_posts   most of the points are on posts
    """

    points: Points
    on_walls: Points
    normals: Matrix
    has_posts: bool


def walls_seen(points: Points, curve_m: Matrix) -> SeenWalls:
    """Walls at a scan's points; curve_m: the bias of its ranges, see bias_at."""
    count = len(points.xy_base)
    xy, normals = np.empty((4, count, 2)), np.empty((count, 3))
    arrays = points.xy_raw, points.xy_base, points.beam, points.sensor_xy_m, curve_m
    laser = points.range_sigma_m, points.spacing_rad, points.usual_gap, len(points.scan.range_m)
    has_posts = walls_of_scan(*arrays, *laser, xy, normals)
    raw, base, moved_raw, moved_base = xy
    unbiased = points._replace(xy_base=base, xy_raw=raw)
    return SeenWalls(unbiased, points._replace(xy_base=moved_base, xy_raw=moved_raw), normals, has_posts)
