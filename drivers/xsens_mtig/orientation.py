"""Rotations: what the device calls its orientation -> quaternion of ENU from the vehicle-like sensor frame.

A quaternion (w, x, y, z) `a_from_b` takes coordinates of b to a. Source of the conventions: MTi User Manual
MT0605P, 4.2.3 and the section on NWU and NED (the sensor's own axes stay as they are in all three); MTi and
MTx User Manual MT0100P, 4.1.2, where the fixed frame is x to the magnetic north, y west, z up.
"""

import math
from collections.abc import Sequence

from drivers.xsens_mtig.mtdata2 import LocalFrame
from drivers.xsens_mtig.reals import Reals

Quaternion = tuple[float, float, float, float]
Vector = tuple[float, float, float]
Axes = tuple[tuple[int, float], ...]  # for x, y, z of the result: which input, and its sign

_H = math.sqrt(0.5)
ENU_FROM: dict[LocalFrame, Quaternion] = {
    LocalFrame.ENU: (1.0, 0.0, 0.0, 0.0),
    LocalFrame.NED: (0.0, _H, _H, 0.0),  # east = y, north = x, up = -z
    LocalFrame.NWU: (_H, 0.0, 0.0, _H),  # east = -y, north = x
}
_AXES = "xyz"


def multiply(a: Sequence[float], b: Sequence[float]) -> Quaternion:
    """a_from_c of a_from_b and b_from_c."""
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    return (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )


def quaternion_of_euler(roll_deg: float, pitch_deg: float, yaw_deg: float) -> Quaternion:
    """Aerospace order: R = Rz(yaw) Ry(pitch) Rx(roll)."""
    cr, sr = _half(roll_deg)
    cp, sp = _half(pitch_deg)
    cy, sy = _half(yaw_deg)
    return multiply(multiply((cy, 0.0, 0.0, sy), (cp, 0.0, sp, 0.0)), (cr, sr, 0.0, 0.0))


def _half(angle_deg: float) -> tuple[float, float]:
    half_rad = math.radians(angle_deg) / 2.0
    return math.cos(half_rad), math.sin(half_rad)


def quaternion_of_matrix(matrix: Sequence[float]) -> Quaternion:
    """matrix: 9 numbers row by row. Shepperd, "Quaternion from rotation matrix", 1978: the largest first."""
    a, b, c, d, e, f, g, h, i = matrix
    candidates = (a + e + i, a - e - i, e - a - i, i - a - e)
    largest = max(range(4), key=candidates.__getitem__)
    scale = 2.0 * math.sqrt(max(1.0 + candidates[largest], 1e-12))
    if largest == 0:
        return (scale / 4.0, (h - f) / scale, (c - g) / scale, (d - b) / scale)
    if largest == 1:
        return ((h - f) / scale, scale / 4.0, (b + d) / scale, (c + g) / scale)
    if largest == 2:
        return ((c - g) / scale, (b + d) / scale, scale / 4.0, (f + h) / scale)
    return ((d - b) / scale, (c + g) / scale, (f + h) / scale, scale / 4.0)


def axes_of(forward: str, up: str) -> Axes:
    """Rotation of device axes to x forward, y left, z up; names are "x", "-z" ... Raises ValueError where
    both lie on one axis.
    """
    forward_axis, up_axis = _axis(forward), _axis(up)
    if forward_axis[0] == up_axis[0]:
        raise ValueError(f"forward_axis {forward} and up_axis {up} are the same axis")
    (i, up_sign), (j, forward_sign) = up_axis, forward_axis
    cross = 1.0 if (j - i) % 3 == 1 else -1.0  # left = up x forward
    return (forward_axis, (3 - i - j, cross * up_sign * forward_sign), up_axis)


def _axis(name: str) -> tuple[int, float]:
    return _AXES.index(name[-1]), -1.0 if name[0] == "-" else 1.0


def apply(axes: Axes, vector: Sequence[float]) -> Vector:
    """A vector of the device in the frame x forward, y left, z up."""
    (i, a), (j, b), (k, c) = axes
    return (a * vector[i], b * vector[j], c * vector[k])


def device_from_axes(axes: Axes) -> Quaternion:
    """The rotation that takes x forward, y left, z up back to the device's axes."""
    matrix = [0.0] * 9
    for column, (row, sign) in enumerate(axes):
        matrix[3 * row + column] = sign
    return quaternion_of_matrix(matrix)


def to_enu(local: LocalFrame, orientation: Reals, device: Quaternion) -> Quaternion:
    """ENU from x forward, y left, z up.

    orientation  4 numbers: quaternion w x y z; 3: roll, pitch, yaw, deg; 9: matrix row by row; all `local`
                 from the device's axes
    device       as device_from_axes gives it
    """
    if len(orientation) == 3:
        quaternion = quaternion_of_euler(*orientation)
    elif len(orientation) == 9:
        quaternion = quaternion_of_matrix(orientation)
    else:
        quaternion = (orientation[0], orientation[1], orientation[2], orientation[3])
    if local != LocalFrame.ENU:
        quaternion = multiply(ENU_FROM[local], quaternion)
    return quaternion if device == (1.0, 0.0, 0.0, 0.0) else multiply(quaternion, device)
