"""Increments of odometry and gyro between two times, for the filter; docs/estimator.md, [5], [8]."""

import math

import numpy as np

from service.kernels.compiled import inner_kernel
from service.kernels.filter_state import ANCHOR, LOCAL, STATES
from service.kernels.linear3 import copy_vector
from service.kernels.se2 import between, compose, exponential, logarithm
from service.kernels.tracks import (
    LAG_WINDOW_NS,
    bridge_s3,
    extrapolated_ns,
    gyro_angle_at,
    last_at_or_before,
    mean_twist,
    odometry_at,
)

GYRO_SCALE = 0.005  # error of the gyro's scale
MAX_SILENT_S = 0.05  # between two samples of a source that works: 20 Hz and more
# Added to a step in which odometry stands, so that scans that see a motion outweigh it; [30].
STANDING_M, STANDING_RAD = 0.003, 0.002


@inner_kernel
def gyro_turn(gyro, last_ns, stamp_ns, settings, turn):
    """The gyro's rotation in rad and its variance into turn (2,); False where it was silent."""
    first = gyro.span[0]
    end = gyro.span[1]
    late_ns = last_ns + np.int64(MAX_SILENT_S * 1e9)
    if end - first < 2 or gyro.stamp_ns[end - 1] <= last_ns or gyro.stamp_ns[first] > late_ns:
        return False
    dt = (stamp_ns - last_ns) * 1e-9
    turn[0] = gyro_angle_at(gyro, stamp_ns) - gyro_angle_at(gyro, last_ns)
    beyond_s = max(0.0, (stamp_ns - gyro.stamp_ns[end - 1]) * 1e-9)
    turn[1] = settings.gyro_walk**2 * dt + (GYRO_SCALE * turn[0]) ** 2
    turn[1] += settings.turn_acceleration**2 * beyond_s**3 / 3.0
    after = min(last_at_or_before(gyro, stamp_ns) + 1, end - 1)
    turn[1] += gyro.value[after, 1] - gyro.value[max(last_at_or_before(gyro, last_ns), first), 1]
    return True


@inner_kernel
def scaled_step(state, before, after, step):
    """Step (3,) between two poses of odometry, with its learnt scale errors."""
    tangent = np.empty(3)
    between(before, after, step)
    logarithm(step, tangent)
    scale = 1.0 + state.scale
    exponential(scale * tangent[0], scale * tangent[1], (1.0 + state.turn_scale) * tangent[2], step)


@inner_kernel
def odometry_step(state, odometry, last_ns, stamp_ns, change, measured):
    """Odometry's increment between two times into state.increment; False where it was silent; [5].

    change     (3,) float64   out: change of odometry's mean speed since the anchor
    measured   (5,) float64   out: motion since the anchor, m, m, rad, and its variances, m^2 and rad^2
    """
    lag_ns = np.int64(round(state.lag_s * 1e9))
    first = odometry.span[0]
    end = odometry.span[1]
    used, increment, settings = state.odometry_used, state.increment, state.settings
    if (
        end - first < 2
        or odometry.stamp_ns[end - 1] + extrapolated_ns(odometry) <= last_ns + min(lag_ns, 0)
        or odometry.stamp_ns[first] > last_ns + lag_ns + np.int64(MAX_SILENT_S * 1e9)
    ):
        used.is_known = False
        return False
    before = np.empty(3)
    after = np.empty(3)
    scratch = np.empty(3)
    by_used_lag = np.empty(3)
    begin_twist = np.empty(3)
    end_twist = np.empty(3)
    if not used.is_known:
        anchor_at(state, odometry, last_ns, lag_ns)
    if used.anchor_ns == last_ns:
        begin_at_anchor(state)
    own0, own_turn0, since0, gap0 = odometry_at(odometry, used.anchor_ns + lag_ns, before, scratch)
    own1, own_turn1, since1, gap1 = odometry_at(odometry, stamp_ns + lag_ns, after, scratch)
    mean_twist(odometry, stamp_ns + lag_ns, end_twist)
    copy_vector(used.twist, begin_twist)
    # Continue from the pose used there, extrapolated or not: the steps then add up to odometry's motion.
    odometry_at(odometry, used.anchor_ns + np.int64(round(used.lag_s * 1e9)), by_used_lag, scratch)
    between(by_used_lag, before, scratch)
    compose(used.pose, scratch, before)
    scaled_step(state, before, after, measured[:3])
    was_extrapolated = used.anchor_ns != last_ns
    if was_extrapolated:
        scaled_step(state, used.newest, after, increment.step)
    else:
        copy_vector(measured[:3], increment.step)
    total_s = (stamp_ns - used.anchor_ns) * 1e-9
    share = (stamp_ns - last_ns) * 1e-9 / total_s
    d = math.hypot(measured[0], measured[1])
    turned = abs(measured[2])
    if stamp_ns - used.anchor_ns < LAG_WINDOW_NS:
        # not from the step itself: by chance a long step would weigh less than a short one
        d = 0.5 * total_s * math.hypot(begin_twist[0] + end_twist[0], begin_twist[1] + end_twist[1])
        turned = 0.5 * total_s * abs(begin_twist[2] + end_twist[2])
    for i in range(3):
        change[i] = end_twist[i] - begin_twist[i]
    walked_m2 = settings.position_walk**2 * d
    walked_rad2 = settings.heading_walk**2 * d + settings.turn_walk**2 * turned
    at_end_s3 = bridge_s3(since1, gap1)
    increment.end_s3 = at_end_s3 if gap1 <= 0.0 else 0.0  # beyond the newest sample
    bridged = bridge_s3(since0, gap0) + (at_end_s3 - increment.end_s3)
    late_m = settings.jitter_s * math.hypot(change[0], change[1])
    late_rad = settings.jitter_s * change[2]
    added_m2 = settings.resolution_m**2 + settings.acceleration**2 * bridged + late_m**2
    added_rad2 = settings.resolution_rad**2 + settings.turn_acceleration**2 * bridged + late_rad**2
    if measured[0] == 0.0 and measured[1] == 0.0 and measured[2] == 0.0:  # stands, or dead odometry; [30]
        added_m2 += STANDING_M**2
        added_rad2 += STANDING_RAD**2
    own_m2, own_rad2 = 0.5 * (own1 - own0), own_turn1 - own_turn0  # the device's own, where it grows
    end_m2 = settings.acceleration**2 * increment.end_s3
    end_rad2 = settings.turn_acceleration**2 * increment.end_s3
    measured[3] = max(walked_m2 + added_m2 + end_m2, own_m2)
    measured[4] = max(walked_rad2 + added_rad2 + end_rad2, own_rad2)
    increment.has_odometry = True
    increment.is_extrapolated = odometry.stamp_ns[end - 1] <= last_ns + min(lag_ns, 0)
    increment.variance_m2 = max(share * walked_m2 + added_m2, share * own_m2)
    increment.variance_rad2 = max(share * walked_rad2 + added_rad2, share * own_rad2)
    copy_vector(after, used.newest)
    return True


@inner_kernel
def anchor_at(state, odometry, stamp_ns, lag_ns):
    """Set the anchor of odometry to this time, that of the newest scan."""
    used = state.odometry_used
    scratch = np.empty(3)
    used.is_known = True
    used.anchor_ns = stamp_ns
    odometry_at(odometry, stamp_ns + lag_ns, used.pose, scratch)
    mean_twist(odometry, stamp_ns + lag_ns, used.twist)
    used.lag_s = lag_ns * 1e-9


@inner_kernel
def begin_at_anchor(state):
    """Begin the motion since the anchor, which is the newest pose."""
    P = state.covariance
    for i in range(3):
        state.odometry_used.since[i] = 0.0
        for j in range(STATES):
            P[ANCHOR + i, j] = P[LOCAL + i, j]
    for j in range(STATES):
        for i in range(3):
            P[j, ANCHOR + i] = P[j, LOCAL + i]
