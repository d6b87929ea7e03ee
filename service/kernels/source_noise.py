"""Learnt noise of odometry, gyro and motion, as factors on the modelled variances.

docs/estimator.md, [18] and [29].
"""

import math

import numpy as np

from service.geometry.chi2 import CHI2_999_OF_1
from service.kernels.compiled import inner_kernel, kernel
from service.kernels.filter_state import BIAS, TWIST, Filter
from service.kernels.pose_information import invert_3x3, wrap
from service.kernels.se2 import between, compose

NOISE_WINDOWS = 10.0  # time constant of the learnt noise, in windows
NOISE_WINDOW_M, WINDOW_S = 0.3, 1.0  # a radian counts as a metre
MIN_NOISE, MAX_NOISE = 0.25, 1e6  # factors on the configured variance, [18]
# Speeds then change by 0.14 m/s and 0.63 rad/s within a second, 1 sigma; rotations begin more suddenly.
MIN_MOTION_NOISE = (0.02, 0.02, 0.1)


@inner_kernel
def extend_window(state, travel_m, dt):
    """Add the increments of the last step to the window."""
    w = state.window
    if state.increments[3] > 0.0:
        compose(w[3:6], state.increments[:3], w[3:6])
        w[6] += state.increments[4] + w[7] * (state.increments[0] ** 2 + state.increments[1] ** 2)
        w[7] += state.increments[5]
    else:
        w[8] = 0.0
    if state.increments[7] > 0.0:
        w[9] += state.increments[6]
        w[10] += state.increments[7]
    else:
        w[11] = 0.0
    w[12] += travel_m
    w[13] += dt


@kernel(Filter)
def begin_window(state):
    state.window[:] = 0.0
    for i in range(3):
        state.window[i] = state.pose[i]
        state.window[14 + i] = state.twist[i]
        state.window[17 + i] = state.covariance[TWIST + i, TWIST + i]
    state.window[8] = state.window[11] = 1.0


@inner_kernel
def learn_noise(state, information, settings):
    """Update the noise of odometry and gyro from their innovations over a window; [18].

    A sample is the squared innovation less the scan's variance, over the modelled variance. It weighs by how
    much more certain the scan is than the source.

    state         Filter           in and out
    information   (3, 3) float64   of the scan alone, base axes
    settings      MotionSettings
    Source: Mehra, On the identification of variances and adaptive Kalman filtering, 1970.
    """
    w = state.window
    if w[12] < NOISE_WINDOW_M and w[13] < WINDOW_S:
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
                known, squared = noise_sample(off[axis], w[6], state.noise[0], 2.0 * alone[axis, axis])
                weight += 0.5 * known
                total += 0.5 * known * squared
            adapt(state.noise, 0, weight, total)
            known, squared = noise_sample(off[2], w[7], state.noise[1], 2.0 * alone[2, 2])
            adapt(state.noise, 1, known, known * squared)
        if w[11] > 0.0:
            known, squared = noise_sample(wrap(step[2] - w[9]), w[10], state.gyro_noise[0], 2.0 * alone[2, 2])
            if squared > CHI2_999_OF_1 * max(state.gyro_noise[0], 1.0):  # the bias may have jumped
                state.covariance[BIAS, BIAS] += known * squared * w[10] / w[13] ** 2
            adapt(state.gyro_noise, 0, known, known * squared)
    learn_motion(state, settings)
    begin_window(state)


@inner_kernel
def learn_motion(state, settings):
    """Update the factor on the variance of the acceleration where only scans measure the motion; [29].

    The model covers all vehicles. For a vehicle at steady speed it is too wide: along a corridor, noise of
    the scans would change the speed. Standstill is excluded.

    Source: Shumway, Stoffer, An approach to time series smoothing and forecasting using EM, 1982.
    """
    w = state.window
    if w[6] > 0.0 or w[7] > 0.0:  # variances: odometry measured a step
        state.motion_noise[:] = 1.0
        return
    lasting_s = w[13] + settings.acceleration_s * math.expm1(-w[13] / settings.acceleration_s)
    moved = min(w[12] / NOISE_WINDOW_M, 1.0)
    for i in range(3):
        if i == 2 and w[10] > 0.0:
            state.motion_noise[i] = 1.0
            continue
        model = lasting_s * (settings.acceleration**2 if i < 2 else settings.turn_acceleration**2)
        alone = w[17 + i] + state.covariance[TWIST + i, TWIST + i]
        share = model / (model + alone)
        sample = ((state.twist[i] - w[14 + i]) ** 2 + alone) / model
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
def adapt(noise, k, weight, total):
    noise[k] += (total - weight * noise[k]) / NOISE_WINDOWS
    noise[k] = min(max(noise[k], MIN_NOISE), MAX_NOISE)
