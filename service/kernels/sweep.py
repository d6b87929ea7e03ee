"""Motion within a sweep beyond constant twist, as predicted and as measured; docs/estimator.md, [23]."""

import math

import numpy as np

from service.geometry.chi2 import CHI2_99_OF_1
from service.kernels.acceleration import transition_over
from service.kernels.arrays import Float64_1D, Float64_2D
from service.kernels.compiled import inner_kernel, kernel
from service.kernels.deskew import deskew_points
from service.kernels.estimator import transform_pose_error
from service.kernels.filter_state import (
    ACCELERATION,
    MAP,
    STATES,
    TWIST,
    FilterRecord,
)
from service.kernels.increments import GYRO_SCALE
from service.kernels.se2 import between, compose, exponential
from service.kernels.tracks import Track, gyro_angle_at, odometry_at

NODE_S = 0.01  # of a sweep, between two times at which the motion is evaluated
MAX_NODES = 65


@inner_kernel
def expected_step(state, seconds, step):
    """Predicted motion of the base over some seconds, negative before the predicted time; [23].

    An acceleration fades backwards in time as it does forwards.
    """
    to_step_s2 = transition_over(abs(seconds), state.settings.acceleration_s).to_step_s2
    twist, acceleration = state.twist, state.acceleration
    exponential(
        seconds * twist[0] + to_step_s2 * acceleration[0],
        seconds * twist[1] + to_step_s2 * acceleration[1],
        seconds * twist[2] + to_step_s2 * acceleration[2],
        step,
    )


@inner_kernel
def expected_variance(state, axis, seconds):
    """Variance of that motion by white acceleration, m^2 or rad^2; axis 0, 1: x, y; 2: theta."""
    settings = state.settings
    density = settings.turn_acceleration if axis == 2 else settings.acceleration
    t = abs(seconds)
    return density * density * t * t * t / 3.0 + state.covariance[TWIST + axis, TWIST + axis] * t * t


@inner_kernel
def gain_of(expected, measured, variance):
    """Gain of a measured deviation, 0 to 1; it falls where the deviation is beyond the gate; [23].

    expected   m^2 or rad^2, prior variance
    measured   m or rad
    variance   m^2 or rad^2, measurement noise
    """
    total = expected + variance
    if expected <= 0.0:
        return 0.0
    return expected / total * min(1.0, CHI2_99_OF_1 * total / max(measured * measured, 1e-12))


@inner_kernel
def covers(track, at_ns, begin_s, end_s):
    """Whether a track has samples before a time and during part of begin_s to end_s about it."""
    first, end = track.span[0], track.span[1]
    if end - first < 2 or track.stamp_ns[first] > at_ns + np.int64(min(begin_s, 0.0) * 1e9):
        return False
    return track.stamp_ns[end - 1] > at_ns + np.int64(max(begin_s, 0.0) * 1e9)


@kernel(FilterRecord, Track, Track, Float64_1D, Float64_2D, Float64_2D)
def deskew_sweep(record, odometry, gyro, beam_time_s, xy_raw, xy_base):
    """Transform the points of a sweep to the base frame at the time of a prediction; [23].

    record        FilterRecord     after the prediction; its time is 0 s
    odometry      Track
    gyro          Track
    beam_time_s   (N,)   float64   s, rising
    xy_raw        (N, 2) float64   in: m, base frame at each point's time; out: base frame at that time for
                                   constant twist
    xy_base       (N, 2) float64   out: m, base frame at 0 s
    """
    state = record[0]
    count = beam_time_s.shape[0]
    if count > 0 and beam_time_s[count - 1] > beam_time_s[0]:
        begin_s, end_s = beam_time_s[0], beam_time_s[count - 1]
        deviation = np.empty((min(2 + int((end_s - begin_s) / NODE_S), MAX_NODES), 3))
        if deviation_over(state, odometry, gyro, begin_s, end_s, deviation):
            apply_deviation(beam_time_s, begin_s, end_s, deviation, xy_raw)
    deskew_points(xy_raw, beam_time_s, state.twist, xy_base)


@inner_kernel
def deviation_over(state, odometry, gyro, begin_s, end_s, deviation):
    """Pose of the base at times of a sweep, relative to that by constant twist; [23].

    state       record of FILTER after a prediction; its time is 0 s
    odometry    Track
    gyro        Track
    begin_s     float            of the sweep
    end_s       float
    deviation   (K, 3) float64   out: m, m, rad at K times evenly from begin_s to end_s; K > 1
    Returns False where it is unknown; deviation is then unchanged.
    """
    at_ns = state.stamp_ns
    lag_ns = np.int64(state.lag_s * 1e9)
    has_odometry = covers(odometry, at_ns + lag_ns, begin_s, end_s)
    has_gyro = covers(gyro, at_ns, begin_s, end_s)
    if not (has_odometry or has_gyro or np.any(state.acceleration != 0.0)):
        return False
    count = deviation.shape[0]
    times_s = np.empty(count)
    expected_at = np.empty((count, 3))
    off = np.zeros((count, 3))  # relative to expected_at
    odometry_rad, odometry_variance = np.zeros(count), np.zeros(count)  # of the rotation in off
    for k in range(count):
        times_s[k] = begin_s + (end_s - begin_s) * k / (count - 1)
        expected_step(state, times_s[k], expected_at[k])
    if has_odometry:
        measure_by_odometry(state, odometry, times_s, expected_at, off, odometry_rad, odometry_variance)
    if has_gyro:
        correct_by_gyro(state, gyro, times_s, has_odometry, odometry_rad, odometry_variance, off)
    step, pose = np.empty(3), np.empty(3)
    twist = state.twist
    for k in range(count):
        t = times_s[k]
        exponential(t * twist[0], t * twist[1], t * twist[2], step)
        compose(expected_at[k], off[k], pose)
        between(step, pose, deviation[k])
    return True


@inner_kernel
def measure_by_odometry(state, track, times_s, expected_at, off, measured_rad, variance_rad2):
    """Deviation from the predicted motion by odometry; [23].

    times_s         (K,)   float64   from the state's time
    expected_at     (K, 3) float64   m, m, rad: predicted motion until then
    off             (K, 3) float64   out: m, m, rad, weighted by its gain
    measured_rad    (K,)   float64   out: its rotation before weighting
    variance_rad2   (K,)   float64   out: noise of that
    """
    settings, at_ns = state.settings, state.stamp_ns + np.int64(state.lag_s * 1e9)
    count = times_s.shape[0]
    origin, pose, scratch = np.empty(3), np.empty(3), np.empty(3)
    step, rest = np.empty(3), np.empty(3)
    odometry_at(track, at_ns, origin, scratch)
    newest_s = (track.stamp_ns[track.span[1] - 1] - at_ns) * 1e-9
    speed, rate = math.hypot(state.twist[0], state.twist[1]), abs(state.twist[2])
    known, variance = np.empty(count), np.empty((count, 2))
    for k in range(count):
        t = times_s[k]
        known[k] = min(t, newest_s)
        odometry_at(track, at_ns + np.int64(known[k] * 1e9), pose, scratch)
        between(origin, pose, step)
        step[0] *= 1.0 + state.scale
        step[1] *= 1.0 + state.scale
        step[2] *= 1.0 + state.turn_scale
        expected_step(state, known[k], scratch)
        between(scratch, expected_at[k], rest)  # beyond the newest sample the predicted motion
        compose(step, rest, step)
        between(expected_at[k], step, off[k])
        path_length_m, turn_rad = speed * abs(t), rate * abs(t)
        distance_variance = settings.position_walk**2 * path_length_m + settings.resolution_m**2
        variance[k, 0] = state.noise[0] * (distance_variance + (settings.jitter_s * speed) ** 2)
        turn_variance = settings.heading_walk**2 * path_length_m + settings.turn_walk**2 * turn_rad
        turn_variance += settings.resolution_rad**2 + (settings.jitter_s * rate) ** 2
        variance[k, 1] = state.noise[1] * turn_variance
        measured_rad[k] = off[k, 2]
        variance_rad2[k] = variance[k, 1]
    for axis in range(3):
        # Empirical Bayes: the deviation beyond noise limits the prior variance (Efron, Morris 1973).
        part = 0.0
        for end in (0, count - 1):
            expected = expected_variance(state, axis, known[end])
            shown = off[end, axis] ** 2 - variance[end, axis // 2]
            if expected > 0.0:
                part = max(part, min(shown / expected, 1.0))
        for k in range(count):
            expected = part * expected_variance(state, axis, known[k])
            off[k, axis] *= gain_of(expected, off[k, axis], variance[k, axis // 2])


@inner_kernel
def correct_by_gyro(state, track, times_s, has_odometry, odometry_rad, odometry_variance, off):
    """Correct the rotation of a deviation by the gyro; [23].

    times_s             (K,)   float64   from the state's time
    odometry_rad        (K,)   float64   rotation beyond the predicted one by odometry, if it has any
    odometry_variance   (K,)   float64   rad^2, of that
    off                 (K, 3) float64   in and out: m, m, rad
    """
    settings, at_ns, rate = state.settings, state.stamp_ns, state.twist[2]
    start_rad = gyro_angle_at(track, at_ns)
    newest_s = (track.stamp_ns[track.span[1] - 1] - at_ns) * 1e-9
    for k in range(times_s.shape[0]):
        known_s = min(times_s[k], newest_s)
        turned = gyro_angle_at(track, at_ns + np.int64(known_s * 1e9)) - start_rad
        to_step_s2 = transition_over(abs(known_s), settings.acceleration_s).to_step_s2
        turned -= (state.bias_radps + rate) * known_s + to_step_s2 * state.acceleration[2]
        variance = settings.gyro_walk**2 * abs(known_s) + (GYRO_SCALE * abs(rate) * known_s) ** 2
        variance *= state.gyro_noise
        kept = gain_of(expected_variance(state, 2, known_s), turned, variance)
        if has_odometry:  # where gyro and odometry contradict each other, the gyro may be dead
            apart = turned - odometry_rad[k]
            both = variance + odometry_variance[k]
            kept *= min(1.0, CHI2_99_OF_1 * both / max(apart * apart, 1e-12))
        off[k, 2] += kept * (turned - off[k, 2])


@kernel(FilterRecord, Track, Track, float, Float64_1D, Float64_1D, Float64_2D)
def motion_at(record, odometry, gyro, seconds, pose, twist, covariance):
    """Motion some seconds from the newest estimate, within its sweep; [23].

    record       FilterRecord     after a correction; its time is 0 s
    odometry     Track
    gyro         Track
    seconds      float            not 0
    pose         (3,)   float64   out: base in odom
    twist        (3,)   float64   out
    covariance   (3, 3) float64   out: of the pose against the first scan, base axes
    """
    state = record[0]
    deviation = np.zeros((2, 3))
    deviation_over(state, odometry, gyro, seconds, 0.0, deviation)
    step = np.empty(3)
    exponential(seconds * state.twist[0], seconds * state.twist[1], seconds * state.twist[2], step)
    compose(step, deviation[0], step)
    compose(state.pose, step, pose)
    over = transition_over(abs(seconds), state.settings.acceleration_s)
    to_twist_s = math.copysign(over.to_twist_s, seconds)
    P = state.covariance.copy()
    transform_pose_error(P, MAP, step)
    for i in range(3):
        twist[i] = state.twist[i] + to_twist_s * state.acceleration[i]
        for j in range(STATES):
            P[MAP + i, j] += seconds * P[TWIST + i, j] + over.to_step_s2 * P[ACCELERATION + i, j]
    for i in range(3):
        for j in range(STATES):
            P[j, MAP + i] += seconds * P[j, TWIST + i] + over.to_step_s2 * P[j, ACCELERATION + i]
    for i in range(3):
        for j in range(3):
            covariance[i, j] = P[MAP + i, MAP + j]


@inner_kernel
def apply_deviation(beam_time_s, begin_s, end_s, deviation, xy_raw):
    """Move each point by the base's deviation from constant twist at its time.

    beam_time_s    (N,)   float64   s, within begin_s to end_s
    deviation      (K, 3) float64   of deviation_over
    xy_raw         (N, 2) float64   in: m, base frame at each point's time; out: base frame at that time for
                                    constant twist
    """
    last = deviation.shape[0] - 1
    per_s = last / (end_s - begin_s)
    for i in range(xy_raw.shape[0]):
        place = min(max((beam_time_s[i] - begin_s) * per_s, 0.0), float(last))
        k = min(int(place), last - 1)
        share = place - k
        turn = deviation[k, 2] + share * (deviation[k + 1, 2] - deviation[k, 2])
        c = math.cos(turn)
        s = math.sin(turn)
        x = xy_raw[i, 0]
        y = xy_raw[i, 1]
        xy_raw[i, 0] = deviation[k, 0] + share * (deviation[k + 1, 0] - deviation[k, 0]) + c * x - s * y
        xy_raw[i, 1] = deviation[k, 1] + share * (deviation[k + 1, 1] - deviation[k, 1]) + s * x + c * y


@kernel(Track, int, Float64_1D)
def begin_twist(track, stamp_ns, twist):
    """Odometry's speed (3,) at the first scan."""
    pose = np.empty(3)
    odometry_at(track, stamp_ns, pose, twist)
