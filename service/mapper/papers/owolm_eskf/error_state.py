"""Inertial navigation state, and a Kalman filter of 15 states over its error.

x forward, y left, z up: the navigation frame is the levelled odom frame. The north-east-down frame of the
paper is rotated by pi about x; the two differ only in the sign of gravity (see strapdown_step).
"""

import math

import numpy as np
import numpy.typing as npt

from service.geometry.se2 import SE2, wrap_angle
from service.kernels.strapdown import (
    ATTITUDE,
    FORCE_BIAS,
    POSITION,
    RATE_BIAS,
    STRAPDOWN_STATES,
    VELOCITY,
    rotation_of,
    strapdown_step,
)

Array = npt.NDArray[np.float64]


def cross_matrix(v: Array) -> Array:
    """(3, 3) with cross_matrix(a) @ b = a x b."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


class ErrorStateFilter:
    """Navigation state and its error: 3 each of position, velocity, attitude, force bias, rate bias.

    Errors are "believed less true" (Qian et al. 2019, eq. 16: r = r_IMU - dr). After each observation the
    error is subtracted from the state, so the predicted error is zero and only its covariance is propagated.
    Transitions and noise are accumulated over the steps since the last observation and applied to the
    covariance together (Phi = ... Phi_2 Phi_1): the same covariance as step by step, in a tenth of the time.

    covariance   (15, 15) of the error as of the last settle()
    arm_m        (3,) the IMU in the base frame
    gravity      m/s^2
    densities    (4,) white noise of force, rate, and walk of their biases; m/s^2, rad/s, m/s^3, rad/s^2 per
                 square root of Hz
    """

    def __init__(self, arm_m: Array, gravity_mps2: float, densities: Array) -> None:
        self.position_m = arm_m.copy()  # of the IMU; the base begins at the origin
        self.velocity_mps = np.zeros(3)
        self.rotation = np.eye(3)
        self.force_bias = np.zeros(3)
        self.rate_bias = np.zeros(3)
        self._arm_m = arm_m
        self._gravity = np.array([0.0, 0.0, -gravity_mps2])
        force, rate, force_walk, rate_walk = densities**2
        self._noise_per_s = np.zeros(
            STRAPDOWN_STATES
        )  # diagonal of G W G^T: rotations leave equal axes unchanged
        self._noise_per_s[VELOCITY:ATTITUDE] = force
        self._noise_per_s[ATTITUDE:FORCE_BIAS] = rate
        self._noise_per_s[FORCE_BIAS:RATE_BIAS] = force_walk
        self._noise_per_s[RATE_BIAS:] = rate_walk
        self.covariance: Array = np.zeros((STRAPDOWN_STATES, STRAPDOWN_STATES))
        self._transition = np.eye(STRAPDOWN_STATES)
        self._noise = np.zeros((STRAPDOWN_STATES, STRAPDOWN_STATES))
        self._step = np.empty((STRAPDOWN_STATES, STRAPDOWN_STATES))

    @property
    def yaw_rad(self) -> float:
        return math.atan2(self.rotation[1, 0], self.rotation[0, 0])

    @property
    def pose(self) -> SE2:
        """Pose of the base."""
        base = self.position_m - self.rotation @ self._arm_m
        return SE2(float(base[0]), float(base[1]), self.yaw_rad)

    def base_velocity(self, rate_radps: Array) -> Array:
        """(3,) m/s of the base, along its horizontal axes; rate: of the body, bias included."""
        about = np.cross(rate_radps - self.rate_bias, self._arm_m)
        velocity = self.velocity_mps - self.rotation @ about
        c, s = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        return np.array([c * velocity[0] + s * velocity[1], c * velocity[1] - s * velocity[0], velocity[2]])

    def advance(self, time_s: float, force_mps2: Array, rate_radps: Array) -> None:
        """Propagate by one inertial step; force and rate in base axes, biases included."""
        strapdown_step(
            self.position_m,
            self.velocity_mps,
            self.rotation,
            force_mps2 - self.force_bias,
            rate_radps - self.rate_bias,
            self._gravity,
            time_s,
            self._step,
        )
        self._gather(self._step, self._noise_per_s * time_s)

    def move(
        self, step: SE2, time_s: float, twist: tuple[float, float, float], sigmas: Array, is_measured: bool
    ) -> None:
        """Propagate by one step from odometry or the last speed, while the IMU is silent.

        step     motion of the base
        twist    speed of the base afterwards, m/s forward and left, rad/s
        sigmas   (3,) of the distance (m), the rotation (rad) and the speed (m/s)
        is_measured   by odometry, along the base's axes; else step and twist follow from the estimated speed,
                      and their errors are correlated
        """
        before = self.rotation.copy()
        base = self.position_m - before @ self._arm_m
        turn = np.empty((3, 3))
        rotation_of(np.array([0.0, 0.0, step.theta_rad]), turn)
        c, s = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        displacement = np.array([c * step.x_m - s * step.y_m, s * step.x_m + c * step.y_m, 0.0])
        self.rotation = turn @ before
        c, s = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        arm = self.rotation @ self._arm_m
        self.position_m = base + displacement + arm
        speed = np.array([c * twist[0] - s * twist[1], s * twist[0] + c * twist[1], 0.0])
        self.velocity_mps = speed + np.cross([0.0, 0.0, twist[2]], arm)

        transition = np.eye(STRAPDOWN_STATES)
        swept = displacement + arm - before @ self._arm_m  # an error of heading rotates the path of the IMU
        transition[VELOCITY:ATTITUDE, :] = 0.0
        if is_measured:
            transition[POSITION:VELOCITY, ATTITUDE:FORCE_BIAS] = -cross_matrix(swept)
            transition[VELOCITY:ATTITUDE, ATTITUDE:FORCE_BIAS] = -cross_matrix(self.velocity_mps)
        else:
            transition[POSITION:VELOCITY, VELOCITY:ATTITUDE] = time_s * np.eye(3)
            transition[VELOCITY:ATTITUDE, VELOCITY:ATTITUDE] = turn
        noise = self._noise_per_s * time_s
        noise[POSITION : POSITION + 2] = sigmas[0] ** 2
        noise[VELOCITY : VELOCITY + 2] = sigmas[2] ** 2
        noise[VELOCITY + 2] = 0.0
        noise[ATTITUDE:FORCE_BIAS] = 0.0
        noise[ATTITUDE + 2] = sigmas[1] ** 2
        self._gather(transition, noise)

    def settle(self) -> None:
        """Apply the accumulated transitions to the covariance."""
        self.covariance = self._transition @ self.covariance @ self._transition.T + self._noise
        self._transition = np.eye(STRAPDOWN_STATES)
        self._noise = np.zeros((STRAPDOWN_STATES, STRAPDOWN_STATES))

    def pose_covariance(self) -> Array:
        """(3, 3) of x, y, yaw of the base, in its own axes."""
        return self._of_base(self.covariance)

    def scale_pose_information(self, weight: float) -> None:
        """Multiply the information of position and yaw by a weight below 1."""
        rows = np.ix_([POSITION, POSITION + 1, ATTITUDE + 2], [POSITION, POSITION + 1, ATTITUDE + 2])
        self.covariance[rows] *= 1.0 / weight

    def observe_pose(self, pose: SE2, covariance_base: Array) -> None:
        """Update with a match: z = r_IMU - r_lidar of x, y, yaw (eqs. 12 to 16), base axes."""
        believed = self.pose
        z = [
            believed.x_m - pose.x_m,
            believed.y_m - pose.y_m,
            wrap_angle(believed.theta_rad - pose.theta_rad),
        ]
        turn = _turn(pose.theta_rad)
        self._update(np.array(z), self.pose_rows(), turn @ covariance_base @ turn.T)

    def observe_speed(self, speed_mps: tuple[float, float], rate_radps: Array, sigma_mps: float) -> None:
        """Update with odometry: speed of the base forward and left."""
        believed = self.base_velocity(rate_radps)
        c, s = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        rows = np.zeros((2, STRAPDOWN_STATES))
        rows[:, VELOCITY : VELOCITY + 2] = [[c, s], [-s, c]]
        z = np.array([believed[0] - speed_mps[0], believed[1] - speed_mps[1]])
        rows[0, ATTITUDE + 2], rows[1, ATTITUDE + 2] = believed[1], -believed[0]
        self._update(z, rows, sigma_mps**2 * np.eye(2))

    def observe_floor(self, sigma_m: float, sigma_mps: float) -> None:
        """Update with zero height and climb, which a planar laser cannot see."""
        rows = np.zeros((2, STRAPDOWN_STATES))
        rows[0, POSITION + 2] = 1.0
        rows[1, VELOCITY + 2] = 1.0
        z = np.array([self.position_m[2] - self._arm_m[2], self.velocity_mps[2]])
        self._update(z, rows, np.diag([sigma_m**2, sigma_mps**2]))

    def pose_rows(self) -> Array:
        """H of x, y and yaw of the base: (3, 15). Yaw is the heading of the body's horizontal x axis."""
        rotation = self.rotation
        rows = np.zeros((3, STRAPDOWN_STATES))
        rows[0, POSITION] = rows[1, POSITION + 1] = 1.0
        rows[:2, ATTITUDE:FORCE_BIAS] = cross_matrix(rotation @ self._arm_m)[:2]
        level = rotation[0, 0] ** 2 + rotation[1, 0] ** 2
        rows[2, ATTITUDE] = -rotation[2, 0] * rotation[0, 0] / level
        rows[2, ATTITUDE + 1] = -rotation[2, 0] * rotation[1, 0] / level
        rows[2, ATTITUDE + 2] = 1.0
        return rows

    def place_at_origin(self) -> None:
        """Reset position and heading to zero without uncertainty; speed, tilt and biases remain."""
        turn = np.empty((3, 3))
        rotation_of(np.array([0.0, 0.0, -self.yaw_rad]), turn)
        self.rotation = turn @ self.rotation
        self.velocity_mps = turn @ self.velocity_mps
        self.position_m = self.rotation @ self._arm_m
        covariance = self.covariance
        for first in (POSITION, VELOCITY, ATTITUDE):
            covariance[first : first + 3, :] = turn @ covariance[first : first + 3, :]
            covariance[:, first : first + 3] = covariance[:, first : first + 3] @ turn.T
        for sure in (slice(POSITION, VELOCITY), slice(ATTITUDE + 2, FORCE_BIAS)):
            covariance[sure, :] = 0.0
            covariance[:, sure] = 0.0

    def _gather(self, transition: Array, noise: Array) -> None:
        self._transition = transition @ self._transition
        self._noise = transition @ self._noise @ transition.T
        self._noise.flat[:: STRAPDOWN_STATES + 1] += noise

    def _of_base(self, covariance: Array) -> Array:
        rows = self.pose_rows()
        turn = _turn(-self.yaw_rad)
        of_base: Array = turn @ (rows @ covariance @ rows.T) @ turn.T
        return of_base

    def _update(self, z: Array, rows: Array, covariance: Array) -> None:
        """Kalman update in Joseph's form; the error is then subtracted from the state (eq. 16)."""
        across = self.covariance @ rows.T
        gain = across @ np.linalg.inv(rows @ across + covariance)
        rest = np.eye(STRAPDOWN_STATES) - gain @ rows
        updated = rest @ self.covariance @ rest.T + gain @ covariance @ gain.T
        self.covariance = 0.5 * (updated + updated.T)
        error = (gain @ z[:, None])[:, 0]
        self.position_m = self.position_m - error[POSITION:VELOCITY]
        self.velocity_mps = self.velocity_mps - error[VELOCITY:ATTITUDE]
        turn = np.empty((3, 3))
        rotation_of(-error[ATTITUDE:FORCE_BIAS], turn)
        self.rotation = _orthonormal(turn @ self.rotation)
        self.force_bias = self.force_bias - error[FORCE_BIAS:RATE_BIAS]
        self.rate_bias = self.rate_bias - error[RATE_BIAS:]


def _turn(angle_rad: float) -> Array:
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _orthonormal(rotation: Array) -> Array:
    """The nearest rotation to a rounded one: one Newton step of the polar decomposition."""
    straight: Array = 0.5 * rotation @ (3.0 * np.eye(3) - rotation.T @ rotation)
    return straight
