"""Strapdown inertial navigation over a flat, non-rotating earth: one step and its error transition."""

import math

import numpy as np

from service.kernels.arrays import Float64_1D, Float64_2D
from service.kernels.compiled import kernel

# Rows of the 15 error states: position, velocity, attitude, biases of accelerometer and gyroscope.
POSITION, VELOCITY, ATTITUDE, FORCE_BIAS, RATE_BIAS = 0, 3, 6, 9, 12
STRAPDOWN_STATES = 15


@kernel(Float64_1D, Float64_2D)
def rotation_of(vector, rotation):
    """Rotation by a rotation vector (Rodrigues).

    vector     (3,)    float64   rad, axis times angle
    rotation   (3, 3)  float64   out
    """
    x, y, z = vector[0], vector[1], vector[2]
    square = x * x + y * y + z * z
    angle = math.sqrt(square)
    if angle < 1e-8:
        s, k, c = 1.0, 0.5, 1.0
    else:
        s, c = math.sin(angle) / angle, math.cos(angle)
        k = (1.0 - c) / square
    rotation[0, 0], rotation[0, 1], rotation[0, 2] = c + k * x * x, k * x * y - s * z, k * x * z + s * y
    rotation[1, 0], rotation[1, 1], rotation[1, 2] = k * x * y + s * z, c + k * y * y, k * y * z - s * x
    rotation[2, 0], rotation[2, 1], rotation[2, 2] = k * x * z - s * y, k * y * z + s * x, c + k * z * z


@kernel(Float64_1D, Float64_1D, Float64_2D, Float64_1D, Float64_1D, Float64_1D, float, Float64_2D)
def strapdown_step(position, velocity, rotation, force_mps2, rate_radps, gravity_mps2, time_s, transition):
    """Propagate the navigation state by one step and compute the transition of its error.

    position       (3,)      float64   in and out: m, navigation frame
    velocity       (3,)      float64   in and out: m/s, navigation frame
    rotation       (3, 3)    float64   in and out: navigation frame from body
    force_mps2     (3,)      float64   specific force over the step, less its bias, body
    rate_radps     (3,)      float64   turn rate over the step, less its bias, body
    gravity_mps2   (3,)      float64   gravity in the navigation frame; its sign defines z up or down
    time_s         float               length of the step
    transition     (15, 15)  float64   out: Phi = I + F dt for errors "believed less true"
    Errors: position and velocity in the navigation frame, attitude as the rotation vector e with
    R_believed = exp(e) R_true, biases in the body.
    Source: Qian et al. 2019, eqs. 6 to 10; Groves, Principles of GNSS, Inertial and Multisensor
    Integrated Navigation Systems, sections 5.2 and 14.2.3. The earth's rotation of 15 deg/h is neglected: it
    is far below the bias of a MEMS gyro.
    """
    turn = np.empty((3, 3))
    half = np.empty(3)
    for i in range(3):
        half[i] = 0.5 * time_s * rate_radps[i]
    rotation_of(half, turn)
    middle = np.zeros((3, 3))  # attitude half way through the step
    for i in range(3):
        for j in range(3):
            for k in range(3):
                middle[i, j] += rotation[i, k] * turn[k, j]
    felt = np.zeros(3)
    for i in range(3):
        for j in range(3):
            felt[i] += middle[i, j] * force_mps2[j]
        acceleration = felt[i] + gravity_mps2[i]
        position[i] += (velocity[i] + 0.5 * acceleration * time_s) * time_s
        velocity[i] += acceleration * time_s
    for i in range(3):
        for j in range(3):
            rotation[i, j] = 0.0
            for k in range(3):
                rotation[i, j] += middle[i, k] * turn[k, j]

    for i in range(transition.shape[0]):
        for j in range(transition.shape[1]):
            transition[i, j] = 1.0 if i == j else 0.0
    for i in range(3):
        transition[POSITION + i, VELOCITY + i] = time_s
        for j in range(3):
            transition[VELOCITY + i, FORCE_BIAS + j] = -middle[i, j] * time_s
            transition[ATTITUDE + i, RATE_BIAS + j] = -middle[i, j] * time_s
    # velocity from attitude: -[R f]x dt
    transition[VELOCITY, ATTITUDE + 1] = felt[2] * time_s
    transition[VELOCITY, ATTITUDE + 2] = -felt[1] * time_s
    transition[VELOCITY + 1, ATTITUDE] = -felt[2] * time_s
    transition[VELOCITY + 1, ATTITUDE + 2] = felt[0] * time_s
    transition[VELOCITY + 2, ATTITUDE] = felt[1] * time_s
    transition[VELOCITY + 2, ATTITUDE + 1] = -felt[0] * time_s
