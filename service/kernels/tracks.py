"""Samples of odometry and gyro in the order of their stamps, interpolated and extrapolated.

Numbers in brackets are those of docs/estimator.md.
"""

from typing import NamedTuple

import numpy as np

from service.kernels.arrays import Float64_2D, Int64_1D
from service.kernels.compiled import inner_kernel
from service.kernels.se2 import between, compose, exponential, logarithm

SPEED_WINDOW_NS = 50_000_000  # over which odometry gives a speed: encoder ticks average out
LAG_WINDOW_NS = 200_000_000  # of the mean speed that a lag of the stamps is multiplied by
ACCELERATION_NS = 100_000_000  # two such windows give the acceleration of a path
LONGEST_WINDOW_NS = 500_000_000  # scans farther apart give none
MAX_EXTRAPOLATED_NS = 375_000_000  # 1.5 periods of 4 Hz: slower sources measure from sample to sample alone
PATH_POSES = 256


class Track(NamedTuple):
    """Samples in the order of their stamps; rows `span[0]` to `span[1]` are in use.

    stamp_ns   (N,)   int64
    value      (N, W) float64   odometry: x m, y m, theta rad, variance m^2, variance rad^2; gyro: angle since
                                the first sample, rad, and the variance added by its pauses
    span       (2,)   int64
    """

    stamp_ns: Int64_1D
    value: Float64_2D
    span: Int64_1D


@inner_kernel
def last_at_or_before(track, stamp_ns):
    """Row of the newest sample that is not after a time; span[0] - 1 where all are."""
    low = track.span[0]
    high = track.span[1]
    while low < high:
        middle = (low + high) // 2
        if track.stamp_ns[middle] <= stamp_ns:
            low = middle + 1
        else:
            high = middle
    return low - 1


@inner_kernel
def extrapolated_ns(track):
    """Time after the newest sample for which the source counts as measuring: another one is due by then."""
    newest = track.span[1] - 1
    period_ns = track.stamp_ns[newest] - track.stamp_ns[newest - 1]
    if newest - 2 >= track.span[0]:
        period_ns = max(period_ns, track.stamp_ns[newest - 1] - track.stamp_ns[newest - 2])
    return min(period_ns + period_ns // 2, MAX_EXTRAPOLATED_NS)


@inner_kernel
def odometry_twist(track, row, twist):
    """Speed between a sample and one at least SPEED_WINDOW_NS before.

    Where all samples are within the window the oldest is taken: a burst of stamps is no speed.
    Returns whether there was time between the two.
    """
    first = row - 1
    while first > track.span[0] and track.stamp_ns[row] - track.stamp_ns[first] < SPEED_WINDOW_NS:
        first -= 1
    twist[:] = 0.0
    if first < track.span[0]:
        return False
    elapsed_s = (track.stamp_ns[row] - track.stamp_ns[first]) * 1e-9
    if elapsed_s <= 0.0:
        return False
    step = np.empty(3)
    between(track.value[first, :3], track.value[row, :3], step)
    logarithm(step, twist)
    for i in range(3):
        twist[i] /= elapsed_s
    return True


@inner_kernel
def odometry_at(track, stamp_ns, pose, twist):
    """Odometry's pose (3,) and twist (3,) at a time.

    Between samples the pose is interpolated by white-noise acceleration, beyond the last the speed is
    constant.
    Returns (the device's own variance m^2, rad^2; seconds since the sample before; seconds from that one to
    the next).
    """
    row = last_at_or_before(track, stamp_ns)
    step = np.empty(3)
    first = track.span[0]
    end = track.span[1]
    if row >= first and row < end - 1:
        gap_ns = track.stamp_ns[row + 1] - track.stamp_ns[row]
        share = (stamp_ns - track.stamp_ns[row]) / gap_ns
        between(track.value[row, :3], track.value[row + 1, :3], step)
        logarithm(step, twist)
        exponential(share * twist[0], share * twist[1], share * twist[2], step)
        compose(track.value[row, :3], step, pose)
        odometry_twist(track, row + 1, twist)
        square_m2 = track.value[row, 3] + share * (track.value[row + 1, 3] - track.value[row, 3])
        square_rad2 = track.value[row, 4] + share * (track.value[row + 1, 4] - track.value[row, 4])
        return square_m2, square_rad2, share * gap_ns * 1e-9, gap_ns * 1e-9
    row = min(max(row, first), end - 1)
    odometry_twist(track, max(row, first + 1), twist)
    elapsed_s = (stamp_ns - track.stamp_ns[row]) * 1e-9
    exponential(elapsed_s * twist[0], elapsed_s * twist[1], elapsed_s * twist[2], step)
    compose(track.value[row, :3], step, pose)
    return track.value[row, 3], track.value[row, 4], abs(elapsed_s), 0.0


@inner_kernel
def mean_twist(track, stamp_ns, twist):
    """Mean speed (3,) over LAG_WINDOW_NS about a time: what a lag of the stamps is multiplied by.

    A speed by two encoder ticks would be noise, and the learnt lag too small.
    """
    before = np.empty(3)
    after = np.empty(3)
    scratch = np.empty(3)
    odometry_at(track, stamp_ns - LAG_WINDOW_NS // 2, before, scratch)
    odometry_at(track, stamp_ns + LAG_WINDOW_NS // 2, after, scratch)
    between(before, after, scratch)
    logarithm(scratch, twist)
    for i in range(3):
        twist[i] /= LAG_WINDOW_NS * 1e-9


@inner_kernel
def add_to_path(path, stamp_ns, pose):
    """Append a pose (3,) to a track of PATH_POSES rows; of a full track the older half is dropped."""
    end = path.span[1]
    if end == path.stamp_ns.shape[0]:
        kept = end // 2
        for i in range(kept):
            path.stamp_ns[i] = path.stamp_ns[end - kept + i]
            for k in range(3):
                path.value[i, k] = path.value[end - kept + i, k]
        path.span[0] = max(path.span[0] - (end - kept), 0)
        end = kept
    path.stamp_ns[end] = stamp_ns
    for k in range(3):
        path.value[end, k] = pose[k]
    path.span[1] = end + 1


@inner_kernel
def acceleration_of(path, odometry, lag_ns, acceleration):
    """Acceleration (3,) at the end of a path, confirmed by odometry: the smaller one, 0 where signs differ.

    Each is that between the mean speeds of two windows. Where a wheel slips, odometry's speed changes and
    that of the path does not; with a dead encoder the reverse.
    Returns the length of a window in s; 0.0 where the path is too short.
    """
    newest = path.span[1] - 1
    middle = last_at_or_before(path, path.stamp_ns[newest] - ACCELERATION_NS)
    if middle < path.span[0]:
        return 0.0
    oldest = last_at_or_before(path, path.stamp_ns[middle] - ACCELERATION_NS)
    if oldest < path.span[0] or path.stamp_ns[newest] - path.stamp_ns[oldest] > 2 * LONGEST_WINDOW_NS:
        return 0.0
    new_s = (path.stamp_ns[newest] - path.stamp_ns[middle]) * 1e-9
    old_s = (path.stamp_ns[middle] - path.stamp_ns[oldest]) * 1e-9
    first = np.empty(3)
    mid = np.empty(3)
    last = np.empty(3)
    scratch = np.empty(3)
    of_odometry = np.empty(3)
    odometry_at(odometry, path.stamp_ns[oldest] + lag_ns, first, scratch)
    odometry_at(odometry, path.stamp_ns[middle] + lag_ns, mid, scratch)
    odometry_at(odometry, path.stamp_ns[newest] + lag_ns, last, scratch)
    change_of_mean(first, mid, last, old_s, new_s, of_odometry)
    change_of_mean(path.value[oldest], path.value[middle], path.value[newest], old_s, new_s, acceleration)
    for i in range(3):
        if of_odometry[i] * acceleration[i] <= 0.0:
            acceleration[i] = 0.0
        elif abs(of_odometry[i]) < abs(acceleration[i]):
            acceleration[i] = of_odometry[i]
    return 0.5 * (new_s + old_s)


@inner_kernel
def change_of_mean(first, middle, last, old_s, new_s, acceleration):
    """Acceleration (3,) between the mean speeds from first to middle and from middle to last pose."""
    step = np.empty(3)
    new = np.empty(3)
    old = np.empty(3)
    between(middle, last, step)
    logarithm(step, new)
    between(first, middle, step)
    logarithm(step, old)
    for i in range(3):
        acceleration[i] = (new[i] / new_s - old[i] / old_s) / (0.5 * (new_s + old_s))


@inner_kernel
def bridge_s3(since_s, gap_s):
    """Variance of a pose between two samples, over the density of acceleration; [8]."""
    if gap_s <= 0.0:
        return since_s**3 / 3.0
    left_s = max(gap_s - since_s, 0.0)
    return (since_s * left_s / gap_s) ** 3 / 3.0


@inner_kernel
def gyro_angle_at(track, stamp_ns):
    """The gyro's angle at a time since the first sample; beyond the last one by its last rate."""
    row = last_at_or_before(track, stamp_ns)
    row = min(max(row, track.span[0]), track.span[1] - 2)
    share = (stamp_ns - track.stamp_ns[row]) / (track.stamp_ns[row + 1] - track.stamp_ns[row])
    return track.value[row, 0] + share * (track.value[row + 1, 0] - track.value[row, 0])
