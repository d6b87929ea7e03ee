"""Learnt noise of odometry, gyro and motion, as factors on the modelled variances.

docs/estimator.md, [18] and [29].
"""

import math

import numpy as np

from service.geometry.chi2 import CHI2_999_OF_1
from service.kernels.compiled import inner_kernel, kernel
from service.kernels.filter_state import BIAS, TWIST, FilterRecord
from service.kernels.pose_information import invert_3x3, wrap
from service.kernels.se2 import between, compose

NOISE_WINDOWS = 10.0  # time constant of the learnt noise, in windows
NOISE_WINDOW_M, WINDOW_S = 0.3, 1.0  # a radian counts as a metre
MIN_NOISE, MAX_NOISE = 0.25, 1e6  # factors on the configured variance, [18]
# Speeds then change by 0.14 m/s and 0.63 rad/s within a second, 1 sigma; rotations begin more suddenly.
MIN_MOTION_NOISE = (0.02, 0.02, 0.1)


@inner_kernel
def extend_window(state, measured, travel_m, dt):
    """Add the motion of the last step to the window; that of odometry once a sample has measured it.

    measured   (5,) float64   from odometry_step
    """
    new, total = state.increment, state.window.increment
    if new.has_odometry and not new.is_extrapolated:
        compose(total.step, measured[:3], total.step)
        total.variance_m2 += measured[3] + total.variance_rad2 * (measured[0] ** 2 + measured[1] ** 2)
        total.variance_rad2 += measured[4]
    elif not new.has_odometry:
        total.has_odometry = False
    if new.has_gyro:
        total.gyro_rad += new.gyro_rad
        total.gyro_rad2 += new.gyro_rad2
    else:
        total.has_gyro = False
    state.window.travel_m += travel_m
    state.window.elapsed_s += dt


@kernel(FilterRecord, int)
def begin_motion(record, stamp_ns):
    """Set the time of the first scan and begin the window of the learnt noise."""
    state = record[0]
    state.stamp_ns = stamp_ns
    begin_window(state)


@inner_kernel
def begin_window(state):
    window = state.window
    window.travel_m = window.elapsed_s = 0.0
    total = window.increment
    total.has_odometry = total.has_gyro = True
    total.variance_m2 = total.variance_rad2 = total.gyro_rad = total.gyro_rad2 = 0.0
    for i in range(3):
        total.step[i] = 0.0
        window.pose[i] = state.pose[i]
        window.twist[i] = state.twist[i]
        window.twist_variance[i] = state.covariance[TWIST + i, TWIST + i]


@inner_kernel
def learn_noise(state, information):
    """Update the noise of odometry and gyro from their innovations over a window; [18].

    A sample is the squared innovation less the scan's variance, over the modelled variance. It weighs by how
    much more certain the scan is than the source.

    state         record of FILTER   in and out
    information   (3, 3) float64   of the scan alone, base axes
    Source: Mehra, On the identification of variances and adaptive Kalman filtering, 1970.
    """
    window = state.window
    if window.travel_m < NOISE_WINDOW_M and window.elapsed_s < WINDOW_S:
        return
    if state.increment.is_extrapolated:
        return  # the window ends with a sample of odometry
    bounded = information.copy()
    for i in range(3):
        bounded[i, i] += 1e-6
    alone = np.zeros((3, 3))
    if invert_3x3(bounded, alone):
        measured = window.increment
        step = np.empty(3)
        between(window.pose, state.pose, step)
        if measured.has_odometry:
            off = np.empty(3)
            between(measured.step, step, off)
            weight = total = 0.0
            for axis in range(2):
                known, squared = noise_sample(
                    off[axis], measured.variance_m2, state.noise[0], 2.0 * alone[axis, axis]
                )
                weight += 0.5 * known
                total += 0.5 * known * squared
            state.noise[0] = adapted(state.noise[0], weight, total)
            known, squared = noise_sample(off[2], measured.variance_rad2, state.noise[1], 2.0 * alone[2, 2])
            state.noise[1] = adapted(state.noise[1], known, known * squared)
        if measured.has_gyro:
            turn = wrap(step[2] - measured.gyro_rad)
            known, squared = noise_sample(turn, measured.gyro_rad2, state.gyro_noise, 2.0 * alone[2, 2])
            if squared > CHI2_999_OF_1 * max(state.gyro_noise, 1.0):  # the bias may have jumped
                state.covariance[BIAS, BIAS] += known * squared * measured.gyro_rad2 / window.elapsed_s**2
            state.gyro_noise = adapted(state.gyro_noise, known, known * squared)
    learn_motion(state)
    begin_window(state)


@inner_kernel
def learn_motion(state):
    """Update the factor on the variance of the acceleration where only scans measure the motion; [29].

    The model covers all vehicles. For a vehicle at steady speed it is too wide: along a corridor, noise of
    the scans would change the speed. Standstill is excluded.

    Source: Shumway, Stoffer, An approach to time series smoothing and forecasting using EM, 1982.
    """
    window = state.window
    if window.increment.variance_m2 > 0.0 or window.increment.variance_rad2 > 0.0:  # odometry measured a step
        state.motion_noise[:] = 1.0
        return
    settings, elapsed_s = state.settings, window.elapsed_s
    lasting_s = elapsed_s + settings.acceleration_s * math.expm1(-elapsed_s / settings.acceleration_s)
    moved = min(window.travel_m / NOISE_WINDOW_M, 1.0)
    for i in range(3):
        if i == 2 and window.increment.gyro_rad2 > 0.0:
            state.motion_noise[i] = 1.0
            continue
        model = lasting_s * (settings.acceleration**2 if i < 2 else settings.turn_acceleration**2)
        alone = window.twist_variance[i] + state.covariance[TWIST + i, TWIST + i]
        share = model / (model + alone)
        sample = ((state.twist[i] - window.twist[i]) ** 2 + alone) / model
        noise = state.motion_noise[i]
        noise += moved * share * share * (sample - noise) / NOISE_WINDOWS
        state.motion_noise[i] = min(max(noise, MIN_MOTION_NOISE[i]), 1.0)


@inner_kernel
def motion_noise_over(learnt, dt):
    """The factor for a step of dt: beyond the length of a window it tends to 1; [29]."""
    return learnt + (1.0 - learnt) * max(0.0, 1.0 - WINDOW_S / dt)


@inner_kernel
def noise_sample(off, model, noise, alone):
    """Noise sample by an innovation of a source.

    off     m or rad by which the corrected pose is off from the source's increment
    model   variance of the source by its model;   noise   learnt factor on it
    alone   variance of the step by the scan alone
    Returns (weight 0..1 of the sample, squared innovation less the scan's variance, over the model).
    """
    variance = model * noise
    left_out = off * (variance + alone) / variance  # as if the source had not been used
    share = model / (model + alone)
    return share * share, (left_out * left_out - alone) / model


@inner_kernel
def adapted(noise, weight, total):
    """Learnt noise after a sample of a weight; total: weight times sample."""
    return min(max(noise + (total - weight * noise) / NOISE_WINDOWS, MIN_NOISE), MAX_NOISE)
