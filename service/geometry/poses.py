"""Many poses in the plane at once: rows (x m, y m, theta rad) of float64 arrays. One alone is an SE2."""

import math

import numpy as np
import numpy.typing as npt

from service.geometry.se2 import SE2, wrap_angle

Floats = npt.NDArray[np.float64]
Poses = Floats  # (..., 3)


def compose(a: Poses, b: Poses) -> Poses:
    """a @ b, row by row; shapes (..., 3) that broadcast."""
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    return _rows(
        a[..., 0] + c * b[..., 0] - s * b[..., 1],
        a[..., 1] + s * b[..., 0] + c * b[..., 1],
        wrap_angle(a[..., 2] + b[..., 2]),
    )


def between(a: Poses, b: Poses) -> Poses:
    """a^-1 @ b, row by row: b seen from a; shapes (..., 3) that broadcast."""
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    dx, dy = b[..., 0] - a[..., 0], b[..., 1] - a[..., 1]
    return _rows(c * dx + s * dy, -s * dx + c * dy, wrap_angle(b[..., 2] - a[..., 2]))


def inverse(pose: Poses) -> Poses:
    """pose^-1, row by row."""
    return between(pose, np.zeros(3))


def adjoint(pose: Poses) -> Floats:
    """(..., 3, 3) what takes a small error at the far end of each pose, in the axes there, to its near end.

    A covariance (3, 3) at the far end is adjoint @ covariance @ adjoint^T at the near one.
    """
    c, s = np.cos(pose[..., 2]), np.sin(pose[..., 2])
    zero, one = np.zeros_like(c), np.ones_like(c)
    rows = ((c, -s, pose[..., 1]), (s, c, -pose[..., 0]), (zero, zero, one))
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def rotated(matrix: Floats, theta_rad: float) -> Floats:
    """A covariance or information (3, 3) of x, y, theta, given in axes turned by theta_rad, in the axes that
    these are turned against.
    """
    c, s = math.cos(theta_rad), math.sin(theta_rad)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    turned: Floats = turn @ matrix @ turn.T
    return turned


def points_from(pose: Poses, xy: Floats) -> Floats:
    """Points given in the frames of the poses, in the frame the poses are given in; (..., 3), (..., 2)."""
    c, s = np.cos(pose[..., 2]), np.sin(pose[..., 2])
    return _rows(
        pose[..., 0] + c * xy[..., 0] - s * xy[..., 1], pose[..., 1] + s * xy[..., 0] + c * xy[..., 1]
    )


def points_seen(pose: Poses, xy: Floats) -> Floats:
    """Points in the frames of the poses; inverse of points_from."""
    c, s = np.cos(pose[..., 2]), np.sin(pose[..., 2])
    dx, dy = xy[..., 0] - pose[..., 0], xy[..., 1] - pose[..., 1]
    return _rows(c * dx + s * dy, -s * dx + c * dy)


def moved_by(pose: SE2, xy: Floats) -> Floats:
    """Points (N, 2) given in the frame of one pose, in the frame that the pose is given in."""
    c, s = math.cos(pose.theta_rad), math.sin(pose.theta_rad)
    moved: Floats = xy @ np.array([[c, s], [-s, c]]) + (pose.x_m, pose.y_m)
    return moved


def log(pose: Poses) -> Floats:
    """Twist times duration that leads to each pose; SE2.log, row by row."""
    half = pose[..., 2] / 2.0
    small = np.abs(half) < 1e-4
    safe = np.where(small, 1.0, half)
    k = np.where(small, 1.0 - half * half / 3.0, safe / np.tan(safe))
    return np.stack(
        (k * pose[..., 0] + half * pose[..., 1], -half * pose[..., 0] + k * pose[..., 1], pose[..., 2]),
        axis=-1,
    )


def _rows(*columns: Floats) -> Floats:
    """np.stack(columns, axis=-1) of columns of one shape, in a tenth of the time where there are few rows."""
    rows = np.empty((*np.shape(columns[0]), len(columns)))
    for k, column in enumerate(columns):
        rows[..., k] = column
    return rows
