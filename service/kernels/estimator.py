"""The error-state filter of the vehicle's motion: one prediction and one correction a scan.

Errors and the rows of the covariance are those of filter_state.py.

docs/estimator.md gives the equations; numbers in brackets are those of that page.
Sources: Barfoot, State Estimation for Robotics, 2017, sections 3.4 (motion priors), 4.2 and 7.3;
Roumeliotis and Burdick, Stochastic cloning, ICRA 2002; Sola, Quaternion kinematics for the error-state
Kalman filter, 2017, chapter 5.
"""

import math

import numpy as np

from service.geometry.chi2 import CHI2_99_OF_1, CHI2_99_OF_3
from service.kernels.acceleration import transition_over
from service.kernels.arrays import Float64_1D, Float64_2D
from service.kernels.compiled import inner_kernel, kernel
from service.kernels.filter_state import (
    ACCELERATION,
    ANCHOR,
    BIAS,
    LAG,
    LOCAL,
    MAP,
    SCALE,
    STATES,
    STEP,
    TURN_SCALE,
    TWIST,
    FilterRecord,
)
from service.kernels.increments import anchor_at, gyro_turn, odometry_step
from service.kernels.pose_information import invert_3x3
from service.kernels.se2 import between, compose, exponential, logarithm
from service.kernels.source_noise import extend_window, learn_noise, motion_noise_over
from service.kernels.tracks import (
    Track,
    acceleration_of,
    add_to_path,
)

MEAN_S = 0.5  # time constant of the mean twist that the scale error is multiplied by; [25]
MIN_CHANGE_SIGMAS = 3.0  # a smaller change of speed is noise and corrects no lag; [26]


@inner_kernel
def observe(covariance, rows, residual, variance, gain, gate, correction):
    """Apply one scalar measurement: rows . error = residual + noise; updates covariance and correction.

    rows   (22,) float64     measurement Jacobian; its LAG entry becomes 0 where the innovation is beyond the
                             gate
    gain   (22,) float64     scratch
    gate   chi2 above which the variance grows until the innovation fits: a Huber weight; [6]
    The gain of MAP is that of LOCAL, and the covariance is updated in Joseph's form; [7].
    """
    projected = np.empty(STATES)
    while True:
        projected[:] = 0.0
        expected = 0.0
        innovation = residual
        for j in range(STATES):
            if rows[j] != 0.0:
                for i in range(STATES):
                    projected[i] += covariance[i, j] * rows[j]
        for j in range(STATES):
            expected += rows[j] * projected[j]
            innovation -= rows[j] * correction[j]
        total = expected + variance
        chi2 = innovation * innovation / total
        if chi2 <= gate or rows[LAG] == 0.0:
            break
        rows[LAG] = 0.0  # no likely lag explains this innovation
    if chi2 > gate:
        # Huber: the weight falls with 1 / |innovation| beyond the gate
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


@kernel(FilterRecord, Track, Track, int)
def predict_motion(record, odometry, gyro, stamp_ns):
    """Propagate to the time of a scan, then apply odometry and gyro as measurements; [3] to [7].

    record     FilterRecord     in and out
    odometry   Track
    gyro       Track
    stamp_ns   int
    """
    state = record[0]
    P = state.covariance
    last_ns = state.stamp_ns
    lag_s = state.lag_s
    dt = (stamp_ns - last_ns) * 1e-9
    increment = state.increment
    increment.has_odometry = increment.has_gyro = increment.is_extrapolated = False
    if dt <= 0.0:
        return
    tangent = np.empty(3)
    step = np.empty(3)
    propagate(state, dt, tangent)
    exponential(tangent[0], tangent[1], tangent[2], step)
    correction = np.zeros(STATES)
    gain = np.empty(STATES)
    rows = np.zeros(STATES)
    turn = np.empty(2)
    odometry_tangent = np.empty(3)
    change = np.empty(3)
    scale_twist = state.scale_twist
    new = 1.0 - math.exp(-dt / MEAN_S)
    of_step = 1.0 - math.exp(-((dt / MEAN_S) ** 2))
    has_gyro = gyro_turn(gyro, last_ns, stamp_ns, state.settings, turn)
    measured = np.empty(5)
    has_sample = odometry_step(state, odometry, last_ns, stamp_ns, change, measured)
    # An extrapolated motion has the noise that the next sample takes back: no independent measurement.
    has_sample = has_sample and not increment.is_extrapolated
    has_odometry = has_sample and max(state.noise[0], state.noise[1]) <= state.settings.fault_noise
    since = state.odometry_used.since
    total_s = dt
    if has_odometry:
        total_s = (stamp_ns - state.odometry_used.anchor_ns) * 1e-9
        of_step = 1.0 - math.exp(-((total_s / MEAN_S) ** 2))
        # linearised at odometry's step: over a long gap the last speed is far from the truth
        between(since, measured[:3], step)
        # (rotations are not wrapped: a speed wrong by a turn per scan would remain)
        logarithm(step, odometry_tangent)
        for i in range(3):
            correction[STEP + i] = tangent[i] - odometry_tangent[i]
        change_of_speed(state, odometry, total_s, of_step, measured, change)
        add_scale_error(P, scale_twist, -1.0, dt)
    if has_gyro:
        increment.has_gyro = True
        increment.gyro_rad = turn[0] - state.bias_radps * dt
        increment.gyro_rad2 = turn[1]
        rows[STEP + 2] = 1.0
        rows[TURN_SCALE] = dt * scale_twist[2] if has_odometry else 0.0
        rows[BIAS] = dt
        residual = increment.gyro_rad - (step[2] if has_odometry else tangent[2])
        observe(P, rows, residual, turn[1] * state.gyro_noise, gain, CHI2_99_OF_1, correction)
    if has_odometry:
        for axis in range(2, -1, -1):
            rows[:] = 0.0
            rows[STEP + axis] = 1.0
            rows[LAG] = -change[axis]
            if total_s > dt:  # since the anchor the pose has moved without odometry
                rows[LOCAL + axis] = 1.0
                rows[ANCHOR + axis] = -1.0
                rows[TURN_SCALE if axis == 2 else SCALE] = -since[axis]
            observe(P, rows, 0.0, odometry_variance(state, measured, axis), gain, CHI2_99_OF_3, correction)
        logarithm(measured[:3], odometry_tangent)
        for i in range(3):
            of_scale = scale_twist[i] * correction[SCALE if i < 2 else TURN_SCALE]
            correction[TWIST + i] += of_scale
            correction[STEP + i] += dt * of_scale
            # over a long step the mean twist is outdated; the noise of a short step must not enter
            newer = odometry_tangent[i] / total_s - state.mean_twist[i]
            scale_twist[i] = state.mean_twist[i] + of_step * newer
            state.mean_twist[i] += new * newer
        add_scale_error(P, scale_twist, 1.0, dt)
    add_to_state(state, step, correction)
    add_step_error(P, step)
    if has_sample:  # also with a fault: its motion is no measurement later on
        anchor_at(state, odometry, stamp_ns, np.int64(round(lag_s * 1e9)))
    extend_window(state, measured, math.hypot(step[0], step[1]) + abs(step[2]), dt)
    state.stamp_ns = stamp_ns


@inner_kernel
def odometry_variance(state, measured, axis):
    """Variance of odometry's motion since the anchor, m^2 or rad^2, with the learnt noise.

    measured   (5,) float64   from odometry_step
    axis       0, 1: x, y; 2: theta
    """
    if axis < 2:
        return measured[3] * state.noise[0]
    return measured[4] * state.noise[1]


@inner_kernel
def propagate(state, dt, tangent):
    """Propagate twist, acceleration and covariance by dt, and the covariance of the step; [3].

    tangent   (3,) float64   out: tangent of the step, m, m, rad
    """
    P = state.covariance
    settings = state.settings
    over = transition_over(dt, settings.acceleration_s)
    for i in range(3):
        for j in range(STATES):
            P[STEP + i, j] = dt * P[TWIST + i, j] + over.to_step_s2 * P[ACCELERATION + i, j]
    for i in range(3):
        for j in range(STATES):
            if j < STEP or j >= TWIST:
                P[j, STEP + i] = P[STEP + i, j]
    for i in range(3):
        for j in range(3):
            P[STEP + i, STEP + j] = (
                dt * P[STEP + i, TWIST + j] + over.to_step_s2 * P[STEP + i, ACCELERATION + j]
            )
    for i in range(3):
        for j in range(STATES):
            P[TWIST + i, j] += over.to_twist_s * P[ACCELERATION + i, j]
            P[ACCELERATION + i, j] *= over.kept
    for j in range(STATES):
        for i in range(3):
            P[j, TWIST + i] += over.to_twist_s * P[j, ACCELERATION + i]
            P[j, ACCELERATION + i] *= over.kept
    for i in range(3):
        q2 = settings.acceleration**2 if i < 2 else settings.turn_acceleration**2
        q2 *= motion_noise_over(state.motion_noise[i], dt)
        P[STEP + i, STEP + i] += q2 * over.step_step
        P[TWIST + i, TWIST + i] += q2 * over.twist_twist
        P[ACCELERATION + i, ACCELERATION + i] += q2 * over.acceleration_acceleration
        for row, column, noise in (
            (STEP + i, TWIST + i, over.step_twist),
            (STEP + i, ACCELERATION + i, over.step_acceleration),
            (TWIST + i, ACCELERATION + i, over.twist_acceleration),
        ):
            P[row, column] += q2 * noise
            P[column, row] += q2 * noise
        tangent[i] = dt * state.twist[i] + over.to_step_s2 * state.acceleration[i]
        state.twist[i] += over.to_twist_s * state.acceleration[i]
        state.acceleration[i] *= over.kept


@kernel(Float64_2D, Float64_1D, float, float)
def add_scale_error(P, scale_twist, times, dt):
    """Add `times` the effect of the scale error to the errors of twist and step; [25].

    scale_twist   (3,) float64   the twist that the scale error is multiplied by
    """
    for i in range(6):
        row = STEP + i  # and TWIST
        k = TURN_SCALE if i % 3 == 2 else SCALE
        by = times * scale_twist[i % 3] * (dt if i < 3 else 1.0)
        for j in range(STATES):
            P[row, j] += by * P[k, j]
        for j in range(STATES):
            P[j, row] += by * P[j, k]


@inner_kernel
def change_of_speed(state, odometry, dt, of_step, measured, change):
    """Change of speed that the lag of odometry's stamps is multiplied by; [26].

    odometry   Track
    dt         float          s, since the anchor
    of_step    float          0..1: share of the change over that time itself
    measured   (5,) float64   from odometry_step
    change     (3,) float64   in: over the step, by odometry; out
    """
    acceleration = np.empty(3)
    add_to_path(state.path, state.stamp_ns, state.pose)
    lag_ns = np.int64(round(state.lag_s * 1e9))
    window_s = acceleration_of(state.path, odometry, lag_ns, acceleration)
    for i in range(3):
        change[i] *= of_step
        if window_s > 0.0:
            seen = acceleration[i] * dt
            noise = min(
                2.0 * odometry_variance(state, measured, i) * dt / window_s**3,
                6.0 * state.covariance[LOCAL + i, LOCAL + i] * dt**2 / window_s**4,
            )
            least = MIN_CHANGE_SIGMAS**2 * noise
            if seen * seen > least:
                change[i] += (1.0 - of_step) * (seen - least / seen)


@inner_kernel
def add_to_state(state, step, correction):
    """Apply a correction to step, twist and learnt parameters, then move the pose by the step."""
    moved = np.empty(3)
    exponential(correction[STEP], correction[STEP + 1], correction[STEP + 2], moved)
    compose(step, moved, step)
    add_beside_pose(state, correction)
    exponential(correction[LOCAL], correction[LOCAL + 1], correction[LOCAL + 2], moved)
    for k in (MAP, LOCAL, ANCHOR):
        transform_pose_error(state.covariance, k, moved)
    correct_since_anchor(state, correction)
    compose(state.pose, moved, state.pose)
    compose(state.pose, step, state.pose)
    compose(state.odometry_used.since, step, state.odometry_used.since)


@inner_kernel
def correct_since_anchor(state, correction):
    """Apply a correction (22,) to the motion since the anchor of odometry."""
    since = state.odometry_used.since
    moved = np.empty(3)
    exponential(
        correction[LOCAL] - correction[ANCHOR],
        correction[LOCAL + 1] - correction[ANCHOR + 1],
        correction[LOCAL + 2] - correction[ANCHOR + 2],
        moved,
    )
    compose(since, moved, since)


@inner_kernel
def add_beside_pose(state, correction):
    """Add a correction (22,) to all but the pose."""
    for i in range(3):
        state.twist[i] += correction[TWIST + i]
        state.acceleration[i] += correction[ACCELERATION + i]
    state.scale += correction[SCALE]
    state.turn_scale += correction[TURN_SCALE]
    state.lag_s += correction[LAG]
    state.bias_radps += correction[BIAS]


@inner_kernel
def transform_pose_error(P, k, step):
    """Transform pose errors k to k + 2 to the axes of a base moved by a step: P <- F P F'; [4]."""
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
def add_step_error(P, step):
    """Transform the pose errors to the new base, add the step's error and clear its rows; [4]."""
    transform_pose_error(P, ANCHOR, step)
    for k in (MAP, LOCAL):
        transform_pose_error(P, k, step)
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
    """Correct the state with a matched pose and its covariance against the local map; [9], [10].

    state              record of FILTER in and out
    pose               (3,)   float64   base in odom, of prediction and scan together
    local_covariance   (3, 3) float64   of it
    prior_weight       float            of the prediction in the match; below 1 its covariance is widened
    The other states follow by their correlation with the pose. Returns False where the prior is singular.
    """
    P = state.covariance
    step = np.empty(3)
    moved = np.empty(3)
    between(state.pose, pose, step)
    logarithm(step, moved)
    for k in (MAP, LOCAL, ANCHOR):
        transform_pose_error(P, k, step)
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
    gain = np.zeros((STATES, 3))
    for i in range(STATES):
        for j in range(3):
            for k in range(3):
                gain[i, j] += P[i, LOCAL + k] * inverse[k, j]
    removed = prior - local_covariance
    correction = np.zeros(STATES)
    for i in range(STATES):
        for j in range(3):
            correction[i] += gain[i, j] * moved[j]
    used = gain.copy()  # the correction moves the pose against map and first scan alike
    for i in range(3):
        for j in range(3):
            used[MAP + i, j] = 1.0 if i == j else 0.0
    taken = np.zeros((STATES, 3))
    spent = np.zeros((STATES, 3))
    for i in range(STATES):
        for j in range(3):
            for k in range(3):
                taken[i, j] += used[i, k] * removed[k, j]
                spent[i, j] += gain[i, k] * removed[k, j]
    for i in range(STATES):
        for j in range(i + 1):
            total = 0.0
            for k in range(3):
                total += taken[i, k] * (gain[j, k] - used[j, k]) + spent[i, k] * used[j, k]
            P[i, j] -= total
            P[j, i] = P[i, j]
    add_beside_pose(state, correction)
    correct_since_anchor(state, correction)
    for i in range(3):
        state.pose[i] = pose[i]
    return True


@kernel(FilterRecord, Float64_1D, Float64_2D, float, Float64_2D)
def take_match(record, pose, local_covariance, prior_weight, information):
    """correct_motion, then learn_noise."""
    state = record[0]
    correct_motion(state, pose, local_covariance, prior_weight)
    learn_noise(state, information)


@kernel(Float64_2D, float)
def transfer_into_map(P, kept):
    """Multiply the error against the local map by a factor: the map takes over part of it; [11].

    kept   float   0..1
    """
    for i in range(3):
        for j in range(STATES):
            P[ANCHOR + i, j] -= (1.0 - kept) * P[LOCAL + i, j]
            P[LOCAL + i, j] *= kept
    for i in range(3):
        for j in range(STATES):
            P[j, ANCHOR + i] -= (1.0 - kept) * P[j, LOCAL + i]
            P[j, LOCAL + i] *= kept
