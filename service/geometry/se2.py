"""Poses in the plane."""

import math
from typing import NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt

Angles = TypeVar("Angles", float, npt.NDArray[np.float64])  # one, or an array of them


def wrap_angle(theta_rad: Angles) -> Angles:
    """The same directions in (-pi, pi]."""
    return -((math.pi - theta_rad) % math.tau - math.pi)


class SE2(NamedTuple):
    """pose_a_b: takes coordinates of b to a. pose_a_c = pose_a_b @ pose_b_c.

    np.array(pose) is (3,) float64, m, m, rad. wrap_angle is written out: a call takes as long as a product.
    """

    x_m: float = 0.0
    y_m: float = 0.0
    theta_rad: float = 0.0

    def __matmul__(self, other: "SE2") -> "SE2":
        x_m, y_m, theta_rad = self
        ahead_m, left_m, turn_rad = other
        c, s = math.cos(theta_rad), math.sin(theta_rad)
        turned_rad = -((math.pi - (theta_rad + turn_rad)) % math.tau - math.pi)
        return SE2(x_m + c * ahead_m - s * left_m, y_m + s * ahead_m + c * left_m, turned_rad)

    def inverse(self) -> "SE2":
        """pose_b_a of a pose_a_b."""
        x_m, y_m, theta_rad = self
        c, s = math.cos(theta_rad), math.sin(theta_rad)
        return SE2(-c * x_m - s * y_m, s * x_m - c * y_m, -((math.pi + theta_rad) % math.tau - math.pi))

    def between(self, other: "SE2") -> "SE2":
        """pose_b_c of a pose_a_b and a pose_a_c: inverse() @ other."""
        c, s = math.cos(self.theta_rad), math.sin(self.theta_rad)
        back_rad = -((math.pi + self.theta_rad) % math.tau - math.pi)
        x_m, y_m = -c * self.x_m - s * self.y_m, s * self.x_m - c * self.y_m
        c, s = math.cos(back_rad), math.sin(back_rad)
        return SE2(
            x_m + c * other.x_m - s * other.y_m,
            y_m + s * other.x_m + c * other.y_m,
            -((math.pi - (back_rad + other.theta_rad)) % math.tau - math.pi),
        )

    def is_step_from(self, last: "SE2", distance_m: float, turn_rad: float) -> bool:
        """Whether it lies that far from another pose, or is turned by that much."""
        if math.hypot(self.x_m - last.x_m, self.y_m - last.y_m) >= distance_m:
            return True
        return abs((math.pi - (self.theta_rad - last.theta_rad)) % math.tau - math.pi) >= turn_rad

    @staticmethod
    def exp(forward_m: float, left_m: float, turn_rad: float) -> "SE2":
        """The pose reached by moving with a constant twist; the arguments are twist times duration.

        Source: Lie group SE(2), closed form; the branch near zero turn is its Taylor series.
        """
        if abs(turn_rad) < 1e-6:
            a, b = 1.0 - turn_rad**2 / 6.0, turn_rad / 2.0
        else:
            # 2 sin^2(turn / 2) is 1 - cos(turn) without its cancellation
            a, b = math.sin(turn_rad) / turn_rad, 2.0 * math.sin(turn_rad / 2.0) ** 2 / turn_rad
        return SE2(a * forward_m - b * left_m, b * forward_m + a * left_m, wrap_angle(turn_rad))

    def log(self) -> tuple[float, float, float]:
        """Twist times duration (forward m, left m, turn rad) that leads here; inverse of exp."""
        half = self.theta_rad / 2.0
        k = 1.0 - half * half / 3.0 if abs(half) < 1e-4 else half / math.tan(half)
        return k * self.x_m + half * self.y_m, -half * self.x_m + k * self.y_m, self.theta_rad
