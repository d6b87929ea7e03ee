"""The error-state filter of the vehicle's motion: one prediction and one correction a scan.

Errors are in base axes of the newest pose: true pose = pose * exp(error). Rows of the covariance:

    MAP    0:3    pose against the first scan
    LOCAL  3:6    pose against the local map, which was built from earlier poses
    STEP   6:9    motion since the last scan; in use within a prediction only
    TWIST  9:12   velocity
    SCALE 12, TURN_SCALE 13   of odometry: true way = (1 + scale) * way said
    LAG   14      of odometry's stamps behind the scans', s
    BIAS  15      of the gyro, rad/s

docs/estimator.md derives every equation; numbers in brackets are those of that page.
Sources: Barfoot, State Estimation for Robotics, 2017, sections 3.4 (white-noise acceleration), 4.2 and 7.3;
Roumeliotis and Burdick, Stochastic cloning, ICRA 2002; Sola, Quaternion kinematics for the error-state
Kalman filter, 2017, chapter 5.
"""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from service.kernels.compiled import inner_kernel, kernel
from service.kernels.pose_information import invert_3x3, wrap
from service.kernels.se2 import between, compose, exponential, logarithm
from service.kernels.tracks import bridge_s3, last_at_or_before, mean_twist, odometry_at, turned_to

MAP, LOCAL, STEP, TWIST, SCALE, TURN_SCALE, LAG, BIAS, STATES = 0, 3, 6, 9, 12, 13, 14, 15, 16
NOISE_WINDOWS = 10.0  # over which the noise of a source is learnt
WINDOW_M, WINDOW_S = 0.3, 1.0  # a radian counts as a metre
LEAST_NOISE, MOST_NOISE = 0.25, 1e6
GYRO_SCALE = 0.005  # error of the gyro's scale
GRACE_NS = 50_000_000  # odometry may begin so much later than the last scan
GATE_CHI2 = 11.3  # 99 % of three degrees of freedom: beyond, a measurement widens until it fits
GATE_CHI2_GYRO = 6.6  # 99 % of one


class MotionSettings(NamedTuple):
    """Documented where they are configured."""

    position_walk: float  # m / sqrt(m)
    heading_walk: float  # rad / sqrt(m)
    turn_walk: float  # rad / sqrt(rad)
    resolution_m: float
    resolution_rad: float
    gyro_walk: float  # rad / sqrt(s)
    acceleration: float  # m/s^2 sqrt(s)
    turn_acceleration: float  # rad/s^2 sqrt(s)
    jitter_s: float
    speed_window_s: float
    fault_noise: float  # times the variance of its model: such odometry is judged but not used


class Filter(NamedTuple):
    """State and covariance; all arrays are changed in place.

    stamp_ns    (1,)     int64     of the newest pose
    pose        (3,)     float64   base in odom
    twist       (3,)     float64   m/s forward, m/s left, rad/s
    learnt      (4,)     float64   scale, turn scale, lag s, gyro bias rad/s
    covariance  (16, 16) float64
    noise       (2,)     float64   how many times its model odometry's variance is: position, heading
    gyro_noise  (1,)     float64   the same of the gyro
    said        (8,)     float64   odometry's step (3) and whether there was one; its variances (2);
                                   gyro's turn less bias, its variance (0: there was none)
    last_odom   (8,)     float64   odometry at the newest pose: pose (3), mean speed up to then (3), lag in s
                                   that they were taken with, whether there was one
    window      (14,)    float64   since sources were judged last: pose then (3); step that odometry said (3),
                                   its variances (2), whether it always said one; turn that the gyro said, its
                                   variance, whether it always did; way in m, time in s
    """

    stamp_ns: npt.NDArray[np.int64]
    pose: npt.NDArray[np.float64]
    twist: npt.NDArray[np.float64]
    learnt: npt.NDArray[np.float64]
    covariance: npt.NDArray[np.float64]
    noise: npt.NDArray[np.float64]
    gyro_noise: npt.NDArray[np.float64]
    said: npt.NDArray[np.float64]
    last_odom: npt.NDArray[np.float64]
    window: npt.NDArray[np.float64]


@inner_kernel
def observe(covariance, rows, residual, variance, gain, gate, correction):
    """One linear measurement: rows . error = residual + noise; changes covariance, adds to correction.

    rows   (16,) float64     gain   (16,) float64   scratch
    gate   chi2 beyond which the noise is widened until the innovation fits: a Huber weight; [6]
    The pose is one, so its error against the first scan moves as that against the local map does, and its
    covariance follows by Joseph's form; [7].
    """
    projected = np.zeros(STATES)
    for j in range(STATES):
        if rows[j] != 0.0:
            for i in range(STATES):
                projected[i] += covariance[i, j] * rows[j]
    expected = 0.0
    innovation = residual
    for j in range(STATES):
        expected += rows[j] * projected[j]
        innovation -= rows[j] * correction[j]
    total = expected + variance
    chi2 = innovation * innovation / total
    if chi2 > gate:
        # Huber: variance grows so that the weight falls with 1 / |innovation| beyond the gate
        total = expected + variance * chi2 / gate
    for i in range(STATES):
        gain[i] = projected[i] / total
    for i in range(3):
        gain[MAP + i] = gain[LOCAL + i]
    for i in range(STATES):
        correction[i] += gain[i] * innovation
        for j in range(i + 1):
            covariance[i, j] += total * gain[i] * gain[j] - gain[i] * projected[j] - projected[i] * gain[j]
            covariance[j, i] = covariance[i, j]
    return chi2


@kernel
def predict_motion(state, odometry, gyro, stamp_ns, settings):
    """Go on to the moment of a scan: white-noise acceleration, then odometry and gyro as measurements.

    state      Filter           in and out
    odometry   Track
    gyro       Track
    stamp_ns   int
    settings   MotionSettings
    """
    P = state.covariance
    last_ns = state.stamp_ns[0]
    dt = (stamp_ns - last_ns) * 1e-9
    state.said[:] = 0.0
    if dt <= 0.0:
        return
    step = np.empty(3)
    exponential(dt * state.twist[0], dt * state.twist[1], dt * state.twist[2], step)
    # [3] the step's error is that of the twist over dt, and what acceleration adds to both
    for i in range(3):
        for j in range(STATES):
            P[STEP + i, j] = dt * P[TWIST + i, j]
    for i in range(3):
        for j in range(STATES):
            if j < STEP or j >= TWIST:
                P[j, STEP + i] = P[STEP + i, j]
    for i in range(3):
        for j in range(3):
            P[STEP + i, STEP + j] = dt * dt * P[TWIST + i, TWIST + j]
    for i in range(3):
        q = settings.acceleration**2 if i < 2 else settings.turn_acceleration**2
        P[STEP + i, STEP + i] += q * dt * dt * dt / 3.0
        P[STEP + i, TWIST + i] += q * dt * dt / 2.0
        P[TWIST + i, STEP + i] += q * dt * dt / 2.0
        P[TWIST + i, TWIST + i] += q * dt
    correction = np.zeros(STATES)
    gain = np.empty(STATES)
    rows = np.zeros(STATES)
    turn = np.empty(2)
    guessed = step.copy()
    twists = np.empty((2, 3))
    knows_turn = gyro_turn(gyro, last_ns, stamp_ns, settings, turn)
    knows_way = odometry_step(state, odometry, last_ns, stamp_ns, settings, twists)
    knows_way = knows_way and max(state.noise[0], state.noise[1]) <= settings.fault_noise
    if knows_way:
        # errors are counted from what odometry said: over a long gap the last speed is far from anything
        for i in range(3):
            step[i] = state.said[i]
        # (turns are not wrapped: a speed that is wrong by a turn a scan would go on for ever)
        said = np.empty(3)
        logarithm(step, said)
        for i in range(3):
            correction[STEP + i] = dt * state.twist[i] - said[i]
    if knows_turn:
        state.said[6] = turn[0] - state.learnt[3] * dt
        state.said[7] = turn[1]
        rows[STEP + 2] = 1.0
        rows[BIAS] = dt
        residual = state.said[6] - (step[2] if knows_way else dt * state.twist[2])
        observe(P, rows, residual, turn[1] * state.gyro_noise[0], gain, GATE_CHI2_GYRO, correction)
    if knows_way:
        for axis in range(2, -1, -1):
            rows[:] = 0.0
            rows[STEP + axis] = 1.0
            rows[SCALE if axis < 2 else TURN_SCALE] = -guessed[axis] if dt < 1.0 else -step[axis]
            rows[LAG] = -(twists[1, axis] - twists[0, axis])
            variance = state.said[4] * state.noise[0] if axis < 2 else state.said[5] * state.noise[1]
            observe(P, rows, 0.0, variance, gain, GATE_CHI2, correction)
    add_to_state(state, step, correction)
    carry(P, step)
    widen_window(state, math.hypot(step[0], step[1]) + abs(step[2]), dt)
    state.stamp_ns[0] = stamp_ns


@inner_kernel
def gyro_turn(gyro, last_ns, stamp_ns, settings, turn):
    """Turn in rad and its variance, turn (2,), that the gyro said; False where it was silent."""
    first = gyro.span[0]
    end = gyro.span[1]
    if end - first < 2 or gyro.stamp_ns[end - 1] <= last_ns or gyro.stamp_ns[first] > last_ns + GRACE_NS:
        return False
    dt = (stamp_ns - last_ns) * 1e-9
    turn[0] = turned_to(gyro, stamp_ns) - turned_to(gyro, last_ns)
    beyond_s = max(0.0, (stamp_ns - gyro.stamp_ns[end - 1]) * 1e-9)
    turn[1] = settings.gyro_walk**2 * dt + (GYRO_SCALE * turn[0]) ** 2
    turn[1] += settings.turn_acceleration**2 * beyond_s**3 / 3.0
    after = min(last_at_or_before(gyro, stamp_ns) + 1, end - 1)
    turn[1] += gyro.value[after, 1] - gyro.value[max(last_at_or_before(gyro, last_ns), first), 1]
    return True


@inner_kernel
def odometry_step(state, odometry, last_ns, stamp_ns, settings, twists):
    """What odometry said of the way between two moments, into state.said; False where it was silent; [5].

    twists   (2, 3) float64   out: mean speeds at both moments, which a lag of its stamps is multiplied by
    """
    lag_ns = np.int64(round(state.learnt[2] * 1e9))
    first = odometry.span[0]
    end = odometry.span[1]
    if (
        end - first < 2
        or odometry.stamp_ns[end - 1] <= last_ns + min(lag_ns, 0)
        or odometry.stamp_ns[first] > last_ns + lag_ns + GRACE_NS
    ):
        state.last_odom[7] = 0.0
        return False
    before = np.empty(3)
    after = np.empty(3)
    scratch = np.empty(3)
    own0, own_turn0, since0, gap0 = odometry_at(odometry, last_ns + lag_ns, settings, before, scratch)
    own1, own_turn1, since1, gap1 = odometry_at(odometry, stamp_ns + lag_ns, settings, after, scratch)
    mean_twist(odometry, last_ns + lag_ns, settings, twists[0])
    mean_twist(odometry, stamp_ns + lag_ns, settings, twists[1])
    way = np.empty(3)
    last = state.last_odom
    if last[7] > 0.0:
        # on from the pose that was used last, guessed or not: steps then add up to what odometry says
        odometry_at(odometry, last_ns + np.int64(round(last[6] * 1e9)), settings, way, scratch)
        between(way, before, way)
        compose(last[:3], way, before)
        for i in range(3):
            twists[0, i] = last[3 + i]
    for i in range(3):
        last[i] = after[i]
        last[3 + i] = twists[1, i]
    last[6] = lag_ns * 1e-9
    last[7] = 1.0
    between(before, after, way)
    logarithm(way, scratch)
    scale = 1.0 + state.learnt[0]
    exponential(scale * scratch[0], scale * scratch[1], (1.0 + state.learnt[1]) * scratch[2], way)
    d = math.hypot(way[0], way[1])
    bridged = bridge_s3(since0, gap0) + bridge_s3(since1, gap1)
    late_m = settings.jitter_s * math.hypot(twists[1, 0] - twists[0, 0], twists[1, 1] - twists[0, 1])
    late_rad = settings.jitter_s * (twists[1, 2] - twists[0, 2])
    square_m2 = settings.position_walk**2 * d + settings.resolution_m**2
    square_m2 += settings.acceleration**2 * bridged + late_m**2
    square_rad2 = settings.heading_walk**2 * d + settings.turn_walk**2 * abs(way[2])
    square_rad2 += settings.resolution_rad**2 + settings.turn_acceleration**2 * bridged + late_rad**2
    for i in range(3):
        state.said[i] = way[i]
    state.said[3] = 1.0
    state.said[4] = max(square_m2, 0.5 * (own1 - own0))  # the device's own, where it grows
    state.said[5] = max(square_rad2, own_turn1 - own_turn0)
    return True


@inner_kernel
def add_to_state(state, step, correction):
    """Put a correction of a prediction into step, twist and what is learnt, and go on by the step."""
    moved = np.empty(3)
    exponential(correction[STEP], correction[STEP + 1], correction[STEP + 2], moved)
    compose(step, moved, step)
    for i in range(3):
        state.twist[i] += correction[TWIST + i]
    for i in range(4):
        state.learnt[i] += correction[SCALE + i]
    exponential(correction[LOCAL], correction[LOCAL + 1], correction[LOCAL + 2], moved)
    move_axes(state.covariance, MAP, moved)
    compose(state.pose, moved, state.pose)
    compose(state.pose, step, state.pose)


@inner_kernel
def move_axes(P, k, step):
    """Errors k to k + 2, of a pose, in axes of a base that lies a step from it: P <- F P F'; [4]."""
    c = math.cos(step[2])
    s = math.sin(step[2])
    x_turn = s * step[0] - c * step[1]
    y_turn = c * step[0] + s * step[1]
    for j in range(STATES):
        x = c * P[k, j] + s * P[k + 1, j] + x_turn * P[k + 2, j]
        P[k + 1, j] = c * P[k + 1, j] - s * P[k, j] + y_turn * P[k + 2, j]
        P[k, j] = x
    for j in range(STATES):
        x = c * P[j, k] + s * P[j, k + 1] + x_turn * P[j, k + 2]
        P[j, k + 1] = c * P[j, k + 1] - s * P[j, k] + y_turn * P[j, k + 2]
        P[j, k] = x


@inner_kernel
def carry(P, step):
    """Errors of the pose in axes of the new base, with that of the step; [4]. The step's rows are cleared."""
    for k in (MAP, LOCAL):
        move_axes(P, k, step)
        for i in range(3):
            for j in range(STATES):
                P[k + i, j] += P[STEP + i, j]
        for i in range(3):
            for j in range(STATES):
                P[j, k + i] += P[j, STEP + i]
    for i in range(3):
        for j in range(STATES):
            P[STEP + i, j] = 0.0
            P[j, STEP + i] = 0.0


@inner_kernel
def correct_motion(state, pose, local_covariance, prior_weight):
    """Take in where a scan puts the base, and how well it is then known against the local map; [9], [10].

    state              Filter           in and out
    pose               (3,)   float64   base in odom, prediction and scan together
    local_covariance   (3, 3) float64   of it
    prior_weight       float            that the prediction had beside the scan; below 1 its error was larger
                                        than believed
    Everything else moves by what it has in common with the pose.
    """
    P = state.covariance
    prior = P[LOCAL : LOCAL + 3, LOCAL : LOCAL + 3].copy()
    if prior_weight < 1.0:
        for i in range(3):
            for j in range(3):
                more = (1.0 / prior_weight - 1.0) * prior[i, j]
                prior[i, j] += more
                P[LOCAL + i, LOCAL + j] += more
                P[MAP + i, MAP + j] += more
                P[LOCAL + i, MAP + j] += more
                P[MAP + i, LOCAL + j] += more
    inverse = np.zeros((3, 3))
    if not invert_3x3(prior, inverse):
        return False
    step = np.empty(3)
    moved = np.empty(3)
    between(state.pose, pose, step)
    logarithm(step, moved)
    gain = np.zeros((STATES, 3))
    for i in range(STATES):
        for j in range(3):
            for k in range(3):
                gain[i, j] += P[i, LOCAL + k] * inverse[k, j]
    lost = prior - local_covariance
    correction = np.zeros(STATES)
    for i in range(STATES):
        for j in range(3):
            correction[i] += gain[i, j] * moved[j]
    used = gain.copy()  # the pose is one: its error against the first scan moves as that against the map
    for i in range(3):
        for j in range(3):
            used[MAP + i, j] = 1.0 if i == j else 0.0
    taken = np.zeros((STATES, 3))
    spent = np.zeros((STATES, 3))
    for i in range(STATES):
        for j in range(3):
            for k in range(3):
                taken[i, j] += used[i, k] * lost[k, j]
                spent[i, j] += gain[i, k] * lost[k, j]
    for i in range(STATES):
        for j in range(i + 1):
            total = 0.0
            for k in range(3):
                total += taken[i, k] * (gain[j, k] - used[j, k]) + spent[i, k] * used[j, k]
            P[i, j] -= total
            P[j, i] = P[i, j]
    move_axes(P, MAP, step)
    for i in range(3):
        state.twist[i] += correction[TWIST + i]
        state.pose[i] = pose[i]
    for i in range(4):
        state.learnt[i] += correction[SCALE + i]
    return True


@kernel
def take_match(state, pose, local_covariance, prior_weight, information):
    """correct_motion, then learn_noise: to hand the filter over takes as long as either."""
    correct_motion(state, pose, local_covariance, prior_weight)
    learn_noise(state, information)


@kernel
def transfer_into_map(P, kept):
    """What a scan adds to the local map carries the pose's error into it: less is left against it; [11].

    kept   float   share of the error that is left, 0..1
    """
    for i in range(3):
        for j in range(STATES):
            P[LOCAL + i, j] *= kept
    for i in range(3):
        for j in range(STATES):
            P[j, LOCAL + i] *= kept


@inner_kernel
def widen_window(state, travel_m, dt):
    """Add what the sources said of the last step to the window that they are judged over."""
    w = state.window
    if state.said[3] > 0.0:
        compose(w[3:6], state.said[:3], w[3:6])
        w[6] += state.said[4] + w[7] * (state.said[0] ** 2 + state.said[1] ** 2)
        w[7] += state.said[5]
    else:
        w[8] = 0.0
    if state.said[7] > 0.0:
        w[9] += state.said[6]
        w[10] += state.said[7]
    else:
        w[11] = 0.0
    w[12] += travel_m
    w[13] += dt


@kernel
def begin_window(state):
    state.window[:] = 0.0
    for i in range(3):
        state.window[i] = state.pose[i]
    state.window[8] = state.window[11] = 1.0


@inner_kernel
def learn_noise(state, information):
    """Hold what odometry and gyro said over a window against what scans say of it; [18].

    The mean of squared innovations, less what the scan does not know, over the variance of the model is how
    many times that variance is. It is learnt by as much as the scan knows better than the source.

    state         Filter           in and out
    information   (3, 3) float64   of the scan alone, base axes
    Source: Mehra, On the identification of variances and adaptive Kalman filtering, 1970.
    """
    w = state.window
    if w[12] < WINDOW_M and w[13] < WINDOW_S:
        return
    bounded = information.copy()
    for i in range(3):
        bounded[i, i] += 1e-6
    alone = np.zeros((3, 3))
    if invert_3x3(bounded, alone):
        step = np.empty(3)
        between(w[:3], state.pose, step)
        if w[8] > 0.0:
            off = np.empty(3)
            between(w[3:6], step, off)
            weight = total = 0.0
            for axis in range(2):
                known, squared = innovation(off[axis], w[6], state.noise[0], 2.0 * alone[axis, axis])
                weight += 0.5 * known
                total += 0.5 * known * squared
            adapt(state.noise, 0, weight, total)
            known, squared = innovation(off[2], w[7], state.noise[1], 2.0 * alone[2, 2])
            adapt(state.noise, 1, known, known * squared)
        if w[11] > 0.0:
            known, squared = innovation(wrap(step[2] - w[9]), w[10], state.gyro_noise[0], 2.0 * alone[2, 2])
            adapt(state.gyro_noise, 0, known, known * squared)
    begin_window(state)


@inner_kernel
def innovation(off, model, noise, alone):
    """What a source's innovation says of its noise.

    off     m or rad that the pose, made with the source, is off from what the source said
    model   variance of the source by its model;   noise   factor on it, as learnt
    alone   variance of the step by the scan alone
    Returns (weight 0..1 of this sample, squared innovation less the scan's own variance, over the model).
    """
    variance = model * noise
    left_out = off * (variance + alone) / variance  # as if the source had had no say
    share = model / (model + alone)
    return share * share, (left_out * left_out - alone) / model


@inner_kernel
def adapt(noise, k, weight, total):
    noise[k] += (total - weight * noise[k]) / NOISE_WINDOWS
    noise[k] = min(max(noise[k], LEAST_NOISE), MOST_NOISE)
