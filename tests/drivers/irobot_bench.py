"""A session and a fake robot in virtual time."""

import itertools
import math
from collections.abc import Callable
from typing import Any

import numpy as np

from drivers.frames import OdometrySample
from drivers.irobot_create.config import IrobotCreateConfig
from drivers.irobot_create.driver import session_maker
from simulators.irobot_create import FakeCreate

S, MS = 1_000_000_000, 1_000_000
CONFIG = IrobotCreateConfig(name="base", device="/dev/null")
CREATE1 = IrobotCreateConfig(name="base", device="/dev/null", model="create1")


class Curve:
    """WheelSource: speed and turn rate that swing, so that nothing cancels."""

    def __init__(self, speed_mps: float = 0.3, turn_radps: float = 0.5, base_m: float = 0.235) -> None:
        self.speed, self.turn, self.half_m = speed_mps, turn_radps, base_m / 2

    def motion(self, time_s: float) -> tuple[float, float]:
        """Path length, m, and heading, rad, since the start."""
        return self.speed * time_s, self.turn * (1.0 - math.cos(0.7 * time_s)) / 0.7

    def wheel_travel_m(self, now_ns: int) -> tuple[float, float]:
        path_length_m, heading_rad = self.motion(now_ns / S)
        return path_length_m - self.half_m * heading_rad, path_length_m + self.half_m * heading_rad

    def pose_between(self, from_ns: int, to_ns: int) -> tuple[float, float, float]:
        """True pose at the later moment in the frame of the earlier, by small steps."""
        times_s = np.linspace(from_ns / S, to_ns / S, 20_001)
        paths_m, headings = np.array([self.motion(float(t)) for t in times_s]).T
        headings -= headings[0]
        middle = 0.5 * (headings[1:] + headings[:-1])
        steps = np.diff(paths_m)
        return float(steps @ np.cos(middle)), float(steps @ np.sin(middle)), float(headings[-1])


STANDING = Curve(0.0, 0.0)


class Bench:
    """A session and a fake robot in virtual time, in steps of 1 ms."""

    def __init__(
        self,
        robot: FakeCreate,
        session: Any,
        read_every_ms: int = 1,
        spoil: Callable[[bytes, int], bytes] = lambda data, now_ns: data,
    ) -> None:
        self.robot, self.session = robot, session
        self.samples: list[OdometrySample] = []
        self.sent = bytearray()  # by the session
        self.now_ns = 0
        self._read_every_ms = read_every_ms
        self.spoil = spoil
        self._waiting = bytearray()
        robot.connected(0)

    def run(self, duration_s: float) -> list[OdometrySample]:
        before = len(self.samples)
        for _ in range(round(duration_s * 1000)):
            self.now_ns += MS
            self.session.tick(self.now_ns)
            if self.session.outbox:
                self.sent += self.session.outbox
                self._waiting += self.robot.receive_data(bytes(self.session.outbox), self.now_ns)
                self.session.outbox.clear()
            if (due_ns := self.robot.next_due_ns(self.now_ns)) is not None and due_ns <= self.now_ns:
                self._waiting += self.spoil(self.robot.due(self.now_ns), self.now_ns)
            if self._waiting and self.now_ns // MS % self._read_every_ms == 0:
                self.samples += self.session.receive_data(bytes(self._waiting), self.now_ns)
                self._waiting.clear()
        return self.samples[before:]


def bench(wheels: Curve = STANDING, config: IrobotCreateConfig = CONFIG, **robot: Any) -> Bench:
    return Bench(FakeCreate(wheels, config.model, **robot), session_maker(config)())


def errors_m_rad(wheels: Curve, samples: list[OdometrySample]) -> tuple[float, float]:
    """How far the reckoned pose is from the true one at the end, both seen from the first sample."""
    first, last = samples[0], samples[-1]
    x_m, y_m, theta_rad = wheels.pose_between(first.stamp_ns, last.stamp_ns)
    c, s = math.cos(first.theta_rad), math.sin(first.theta_rad)
    dx_m, dy_m = last.x_m - first.x_m, last.y_m - first.y_m
    forward_m, left_m = c * dx_m + s * dy_m, -s * dx_m + c * dy_m
    turned_rad = math.remainder(last.theta_rad - first.theta_rad - theta_rad, math.tau)
    return math.hypot(forward_m - x_m, left_m - y_m), abs(turned_rad)


def largest_step_m(samples: list[OdometrySample]) -> float:
    return max(math.hypot(b.x_m - a.x_m, b.y_m - a.y_m) for a, b in itertools.pairwise(samples))
