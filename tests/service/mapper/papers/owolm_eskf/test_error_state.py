"""The filter against a world with its own noise: signs, lever arm, and whether it knows how wrong it is."""

import math

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from service.geometry.se2 import SE2
from service.kernels.strapdown import ATTITUDE, FORCE_BIAS, RATE_BIAS, STRAPDOWN_STATES, VELOCITY, rotation_of
from service.mapper.papers.owolm_eskf.error_state import ErrorStateFilter

DENSITIES = np.array([0.003, 0.001, 0.001, 0.0001])
IMU_S = 0.01  # the filter is the same at 200 Hz, and a test of 50 runs takes seconds
STEPS_PER_SCAN = 5
UP = np.array([0.0, 0.0, 9.81])  # what a standing accelerometer feels
MATCH_SIGMA = np.array([0.01, 0.01, 0.002])
FIRST_SIGMA = np.concatenate([np.zeros(3), [0.1, 0.1, 0.02], [0.02, 0.02, 0.0], [0.02] * 3, [0.002] * 3])


class Flight:
    """A true motion, and what an IMU with an arm and with errors sampled once measures of it."""

    def __init__(self, seed: int, arm_m: np.ndarray | None = None) -> None:
        self.noise = np.random.default_rng(seed)
        self.arm_m = np.zeros(3) if arm_m is None else arm_m
        first = FIRST_SIGMA * self.noise.standard_normal(STRAPDOWN_STATES)
        self.filter = ErrorStateFilter(self.arm_m, 9.81, DENSITIES)
        self.filter.covariance = np.diag(FIRST_SIGMA**2)
        self.rotation = Rotation.from_rotvec(-first[ATTITUDE:FORCE_BIAS]).as_matrix()
        self.position = self.rotation @ self.arm_m
        self.velocity = -first[VELOCITY:ATTITUDE]
        self.force_bias = -first[FORCE_BIAS:RATE_BIAS]
        self.rate_bias = -first[RATE_BIAS:]

    def step(self, time_s: float) -> None:
        """The IMU's own truth: it accelerates and turns as it likes, the floor ends nothing here."""
        acceleration = np.array([0.8 * math.sin(time_s), 0.5 * math.cos(1.3 * time_s), 0.0])
        rate = np.array([0.05 * math.sin(2 * time_s), 0.04 * math.cos(time_s), 0.6 * math.sin(0.7 * time_s)])
        half = np.empty((3, 3))
        rotation_of(0.5 * IMU_S * rate, half)
        middle = self.rotation @ half
        force = middle.T @ (acceleration + UP)
        self.position = self.position + self.velocity * IMU_S + 0.5 * acceleration * IMU_S**2
        self.velocity = self.velocity + acceleration * IMU_S
        self.rotation = middle @ half
        white = DENSITIES[:2] / math.sqrt(IMU_S)
        self.filter.advance(
            IMU_S,
            force + self.force_bias + white[0] * self.noise.standard_normal(3),
            rate + self.rate_bias + white[1] * self.noise.standard_normal(3),
        )
        self.force_bias = self.force_bias + DENSITIES[2] * math.sqrt(IMU_S) * self.noise.standard_normal(3)
        self.rate_bias = self.rate_bias + DENSITIES[3] * math.sqrt(IMU_S) * self.noise.standard_normal(3)

    def base(self) -> SE2:
        place = self.position - self.rotation @ self.arm_m
        return SE2(place[0], place[1], math.atan2(self.rotation[1, 0], self.rotation[0, 0]))

    def see(self) -> None:
        self.filter.settle()
        self.filter.observe_pose(
            self.base() @ SE2(*(MATCH_SIGMA * self.noise.standard_normal(3))), np.diag(MATCH_SIGMA**2)
        )

    def error(self) -> np.ndarray:
        f = self.filter
        return np.concatenate(
            [
                f.position_m - self.position,
                f.velocity_mps - self.velocity,
                Rotation.from_matrix(f.rotation @ self.rotation.T).as_rotvec(),
                f.force_bias - self.force_bias,
                f.rate_bias - self.rate_bias,
            ]
        )

    def fly(self, seconds: float) -> None:
        for k in range(round(seconds / IMU_S)):
            self.step(k * IMU_S)
            if (k + 1) % STEPS_PER_SCAN == 0:
                self.see()


def test_the_error_lies_within_its_covariance_over_50_runs():  # B7 B11 B12 B13
    """NEES of all 15 states and of the pose, at the end of 2 s: means within their 95 % bands."""
    runs = 50
    full, pose = [], []
    for seed in range(runs):
        flight = Flight(seed, arm_m=np.array([0.3, -0.1, 0.0]))
        flight.fly(2.0)
        error, covariance = flight.error(), flight.filter.covariance
        full.append(error @ np.linalg.solve(covariance, error))
        away = flight.base().inverse() @ flight.filter.pose
        apart = np.array(away)
        pose.append(apart @ np.linalg.solve(flight.filter.pose_covariance(), apart))
    for nees, states in ((full, STRAPDOWN_STATES), (pose, 3)):
        low, high = chi2.ppf([0.025, 0.975], runs * states) / runs
        assert low < np.mean(nees) < high, (states, np.mean(nees), low, high)
