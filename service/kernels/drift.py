"""Covariances of a pose in the plane: carried over a step, grown, and joined with what a scan says."""

import math

import numpy as np
from numba import njit

from service.kernels.pose_information import invert_3x3

LEAST_INFORMATION = 1e-4  # (100 m, 100 rad): keeps inverses finite where nothing is known


@njit(cache=True, nogil=True)
def covariance_of(information, covariance):
    """Covariance of an information that may be silent about a direction: LEAST_INFORMATION is put under it.

    information, covariance   (3, 3) float64
    """
    bounded = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            bounded[i, j] = information[i, j]
        bounded[i, i] += LEAST_INFORMATION
    invert_3x3(bounded, covariance)


@njit(cache=True, nogil=True)
def carry_covariance(covariance, step, carried):
    """Covariance of a pose in base axes, after a step: a turn of the old base moves the new one.

    covariance, carried   (3, 3) float64   may be the same array
    step                  (3,)   float64   new base in the old one, m, m, rad
    """
    c = math.cos(step[2])
    s = math.sin(step[2])
    J = np.zeros((3, 3))
    J[0, 0] = c
    J[0, 1] = s
    J[0, 2] = s * step[0] - c * step[1]
    J[1, 0] = -s
    J[1, 1] = c
    J[1, 2] = c * step[0] + s * step[1]
    J[2, 2] = 1.0
    result = np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            for k in range(3):
                for m in range(3):
                    result[i, j] += J[i, k] * covariance[k, m] * J[j, m]
    for i in range(3):
        for j in range(3):
            carried[i, j] = result[i, j]


@njit(cache=True, nogil=True)
def join_information(first, second, covariance):
    """Covariance of two sources together.

    first, second   (3, 3) float64   information of each
    covariance      (3, 3) float64   out
    """
    total = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            total[i, j] = first[i, j] + second[i, j]
    covariance_of(total, covariance)


@njit(cache=True, nogil=True)
def advance_drift(covariance, along, step, walk, information, share):
    """Let the error of a map grow by the piece that a step adds to it.

    covariance    (3, 3) float64   in and out: of the map, in base axes
    along         (3,)   float64   in and out: error of the pose for an error of the wheels' scale by 1
    step          (3,)   float64   new base in the old one, m, m, rad
    walk          (3,)   float64   variances that dead reckoning alone would lose over the step
    information   (3, 3) float64   of the scan's points, in base axes
    share         float            of the points' covariance that the step adds; 0 adds nothing
    """
    carry_covariance(covariance, step, covariance)
    c = math.cos(step[2])
    s = math.sin(step[2])
    x = along[0] - along[2] * step[1]
    y = along[1] + along[2] * step[0]
    along[0] = c * x + s * y
    along[1] = -s * x + c * y
    if share <= 0.0:
        return
    scaled = np.empty((3, 3))
    walked = np.zeros((3, 3))
    added = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            scaled[i, j] = information[i, j] / share
        walked[i, i] = 1.0 / walk[i]
    join_information(scaled, walked, added)
    for i in range(3):
        along[i] += added[i, 0] * walked[0, 0] * step[0] + added[i, 1] * walked[1, 1] * step[1]
        for j in range(3):
            covariance[i, j] += added[i, j]


@njit(cache=True, nogil=True)
def match_information(points, scale, floor, information):
    """What a scan says of the pose on the map: its points, and errors that all points share.

    points        (3, 3) float64   information of the points, in base axes
    scale         float            of it that counts: points lie nearer than assumed, but share errors
    floor         (3,)   float64   variances of the shared errors
    information   (3, 3) float64   out
    """
    scaled = np.empty((3, 3))
    covariance = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            scaled[i, j] = scale * points[i, j]
    covariance_of(scaled, covariance)
    for i in range(3):
        covariance[i, i] += floor[i]
    invert_3x3(covariance, information)
