"""Poses (3,) in the plane, x m, y m, theta rad, for kernels; see service/geometry/se2.py."""

import math

from service.kernels.compiled import inner_kernel
from service.kernels.pose_information import wrap


@inner_kernel
def compose(a, b, out):
    """a * b of poses (3,); out may be a or b."""
    c = math.cos(a[2])
    s = math.sin(a[2])
    x = a[0] + c * b[0] - s * b[1]
    y = a[1] + s * b[0] + c * b[1]
    out[2] = wrap(a[2] + b[2])
    out[0] = x
    out[1] = y


@inner_kernel
def between(a, b, out):
    """a^-1 * b of poses (3,)."""
    c = math.cos(a[2])
    s = math.sin(a[2])
    dx = b[0] - a[0]
    dy = b[1] - a[1]
    out[0] = c * dx + s * dy
    out[1] = -s * dx + c * dy
    out[2] = wrap(b[2] - a[2])


@inner_kernel
def exponential(x, y, turn, out):
    """Pose after a constant twist times duration."""
    if abs(turn) < 1e-6:
        a = 1.0 - turn * turn / 6.0
        b = 0.5 * turn
    else:
        a = math.sin(turn) / turn
        half = math.sin(0.5 * turn)
        b = 2.0 * half * half / turn
    out[0] = a * x - b * y
    out[1] = b * x + a * y
    out[2] = wrap(turn)


@inner_kernel
def logarithm(pose, out):
    """Twist times duration that reaches a pose; inverse of exponential."""
    half = 0.5 * pose[2]
    k = 1.0 - half * half / 3.0 if abs(half) < 1e-4 else half / math.tan(half)
    out[0] = k * pose[0] + half * pose[1]
    out[1] = -half * pose[0] + k * pose[1]
    out[2] = pose[2]
