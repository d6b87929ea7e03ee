"""Contradictions between scans and a frozen map: objects in free space, beams through walls."""

import math
from typing import NamedTuple

import numpy as np

from service.kernels.arrays import Float64_1D, Float64_2D, Int32_2D, UInt8_2D
from service.kernels.compiled import inner_kernel, seldom_kernel
from service.kernels.rays import BEHIND_M, begin_ray, next_cell

CELL_UNKNOWN, CELL_FREE, CELL_WALL = 0, 1, 2
MIN_SINE = 0.4  # of the angle between beam and wall: beams along a wall are no evidence against it
MIN_ELONGATION = 4.0  # length over width of the wall cells around a cell, from which on they have a direction
MAX_VOTES = 200  # of either kind; then both are halved, so that newer votes count more


class ChangeVotes(NamedTuple):
    """Votes of scans on the cells of a map. Row 0, column 0 is the cell at (first_row, first_column).

    stored     (H, W) uint8    CELL_UNKNOWN, CELL_FREE or CELL_WALL, of the map
    changed    (H, W) uint8    scans that contradict it
    same       (H, W) uint8    scans that confirm it, since the first contradiction
    poses      (H, W) uint8    poses from which it was contradicted
    last_pose  (H, W) int32    number of the last of them
    first_ms, last_ms  (H, W) int32   times of the first and of the last contradiction
    hit, passed        (H, W) int32   number of the last scan that ended in the cell, or passed through it
    first_row, first_column   int
    cell_m     float
    """

    stored: UInt8_2D
    changed: UInt8_2D
    same: UInt8_2D
    poses: UInt8_2D
    last_pose: Int32_2D
    first_ms: Int32_2D
    last_ms: Int32_2D
    hit: Int32_2D
    passed: Int32_2D
    first_row: int
    first_column: int
    cell_m: float


class Moment(NamedTuple):
    """Numbers of a scan and of its pose, from 1, and the time."""

    scan: int
    pose: int
    now_ms: int


@seldom_kernel(Float64_2D, Float64_1D, Float64_1D, float, ChangeVotes, Moment)
def weigh_changes(xy_base, sensor_base, pose, farthest_m, votes, moment):
    """Add the votes of one scan, at most one per cell.

    xy_base       (N, 2) float64   ends of beams, m, base frame
    sensor_base   (2,)   float64   start of the beams
    pose          (3,)   float64   base in the map
    farthest_m    float            longer beams are ignored
    votes         ChangeVotes      in and out
    moment        Moment
    """
    c, s = math.cos(pose[2]), math.sin(pose[2])
    cell_m = votes.cell_m
    u = (pose[0] + c * sensor_base[0] - s * sensor_base[1]) / cell_m - votes.first_column
    v = (pose[1] + s * sensor_base[0] + c * sensor_base[1]) / cell_m - votes.first_row
    height, width = votes.stored.shape
    count = xy_base.shape[0]
    ends = np.empty((count, 2))
    for i in range(count):
        ends[i, 0] = (pose[0] + c * xy_base[i, 0] - s * xy_base[i, 1]) / cell_m - votes.first_column
        ends[i, 1] = (pose[1] + s * xy_base[i, 0] + c * xy_base[i, 1]) / cell_m - votes.first_row
        row, column = math.floor(ends[i, 1]), math.floor(ends[i, 0])
        if 0 <= row < height and 0 <= column < width:
            votes.hit[row, column] = moment.scan
    for i in range(count):
        far_m = math.hypot(ends[i, 0] - u, ends[i, 1] - v) * cell_m
        if far_m > farthest_m:
            continue
        _weigh_end(math.floor(ends[i, 1]), math.floor(ends[i, 0]), votes, moment)
        _weigh_path(u, v, ends[i, 0] - u, ends[i, 1] - v, far_m, votes, moment)


@inner_kernel
def _weigh_end(row, column, votes, moment):
    """Vote for an object at the end of a beam."""
    height, width = votes.stored.shape
    if not (1 <= row < height - 1 and 1 <= column < width - 1):
        return
    is_free = True
    for r in range(row - 1, row + 2):
        for q in range(column - 1, column + 2):
            is_free = is_free and votes.stored[r, q] == CELL_FREE
            if (
                votes.stored[r, q] == CELL_WALL
                and votes.changed[r, q] > 0
                and votes.passed[r, q] != moment.scan
            ):
                votes.passed[r, q] = moment.scan
                _add_vote(votes.same, votes.changed, r, q)
    if is_free and votes.passed[row, column] != moment.scan:
        votes.passed[row, column] = moment.scan
        _contradict(row, column, votes, moment)


@inner_kernel
def _weigh_path(u, v, du, dv, far_m, votes, moment):
    """Vote for free space along a beam, up to BEHIND_M before its end."""
    height, width = votes.stored.shape
    share = 1.0 - BEHIND_M / far_m if far_m > BEHIND_M else 0.0
    column, row, step_column, step_row, next_column, next_row, per_column, per_row, steps = begin_ray(
        u, v, share * du, share * dv
    )
    for _ in range(steps):
        if 1 <= row < height - 1 and 1 <= column < width - 1 and votes.passed[row, column] != moment.scan:
            stored = votes.stored[row, column]
            if (stored == CELL_WALL or votes.changed[row, column] > 0) and not _is_hit(
                row, column, votes, moment
            ):
                if stored == CELL_FREE:
                    votes.passed[row, column] = moment.scan
                    _add_vote(votes.same, votes.changed, row, column)
                elif stored == CELL_WALL and _crosses(row, column, du, dv, votes):
                    votes.passed[row, column] = moment.scan
                    _contradict(row, column, votes, moment)
        column, row, next_column, next_row = next_cell(
            column, row, step_column, step_row, next_column, next_row, per_column, per_row
        )


@inner_kernel
def _is_hit(row, column, votes, moment):
    """Whether this scan ended in the 3 x 3 cells around a cell."""
    for r in range(row - 1, row + 2):
        for q in range(column - 1, column + 2):
            if votes.hit[r, q] == moment.scan:
                return True
    return False


@inner_kernel
def _crosses(row, column, du, dv, votes):
    """Whether a beam crosses the wall of a cell rather than running along it."""
    height, width = votes.stored.shape
    count = sx = sy = xx = xy = yy = 0.0
    for r in range(max(row - 2, 0), min(row + 3, height)):
        for q in range(max(column - 2, 0), min(column + 3, width)):
            if votes.stored[r, q] == CELL_WALL:
                x, y = float(q - column), float(r - row)
                count += 1.0
                sx += x
                sy += y
                xx += x * x
                xy += x * y
                yy += y * y
    xx = xx / count - (sx / count) ** 2 + 0.08  # variance within a cell
    yy = yy / count - (sy / count) ** 2 + 0.08
    xy = xy / count - sx * sy / (count * count)
    half = 0.5 * (xx + yy)
    root = math.sqrt(max(0.25 * (xx - yy) ** 2 + xy * xy, 0.0))
    if half + root < MIN_ELONGATION * (half - root):
        return True
    angle = 0.5 * math.atan2(2.0 * xy, xx - yy)
    sine = abs(math.cos(angle) * dv - math.sin(angle) * du) / max(math.hypot(du, dv), 1e-9)
    return sine >= MIN_SINE


@inner_kernel
def _contradict(row, column, votes, moment):
    if votes.changed[row, column] == 0:
        votes.first_ms[row, column] = moment.now_ms
    votes.last_ms[row, column] = moment.now_ms
    if votes.last_pose[row, column] != moment.pose:
        votes.last_pose[row, column] = moment.pose
        votes.poses[row, column] = min(votes.poses[row, column] + 1, MAX_VOTES)
    _add_vote(votes.changed, votes.same, row, column)


@inner_kernel
def _add_vote(mine, other, row, column):
    mine[row, column] += 1
    if mine[row, column] >= MAX_VOTES:
        mine[row, column] //= 2
        other[row, column] //= 2
