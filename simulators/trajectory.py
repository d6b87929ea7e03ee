"""Smooth drives of a wheeled vehicle: pose and twist as functions of time.

A drive is a list of legs (follow waypoints, spin, pause), each from rest to rest. Corners are arcs whose
curvature ramps in and out, so pose, heading, speed and turn rate are continuous and the twist is the
derivative of the pose. The vehicle moves along its heading only; it never goes sideways.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from service.geometry.se2 import SE2, wrap_angle

Floats = npt.NDArray[np.float64]

NODE_S = 0.01  # a drive is stored at these steps; cubic between them
STEP_M = 0.005  # path samples while it is being shaped
EASE_M = 0.3  # curvature ramps over twice this distance: a moving mean of this width, applied twice
SAME_POSE = 1e-6  # m and rad; a drive that repeats ends where it began

PATH_LENGTH, X, Y, THETA, SPEED, TURN_RATE = range(6)  # columns of a node


@dataclass(frozen=True, slots=True)
class Limits:
    speed_mps: float = 1.0
    acceleration_mps2: float = 0.6
    lateral_mps2: float = 0.6  # speed in a corner
    turn_rate_radps: float = 1.0
    turn_acceleration_radps2: float = 2.0


@dataclass(frozen=True, slots=True)
class Pause:
    """Stand still."""

    seconds: float


@dataclass(frozen=True, slots=True)
class Spin:
    """Turn on the spot; positive is counter-clockwise."""

    turn_rad: float


@dataclass(frozen=True, slots=True)
class Follow:
    """Drive along these points, first of all turning on the spot to face the first of them."""

    points: Sequence[tuple[float, float]]
    corner_radius_m: float = 0.6


Leg = Pause | Spin | Follow


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """A finished drive. Before its beginning the vehicle stands at the start; after the end it stands there,
    or drives the same again for ever where `repeats` is set.
    """

    nodes: Floats  # (M, 6) at NODE_S: distance m, x m, y m, theta rad (unwrapped), speed m/s, turn rate rad/s
    repeats: bool

    @property
    def duration_s(self) -> float:
        return (len(self.nodes) - 1) * NODE_S

    @property
    def length_m(self) -> float:
        return float(self.nodes[-1, PATH_LENGTH])

    @property
    def start(self) -> SE2:
        return SE2(*map(float, self.nodes[0, X : THETA + 1]))

    def poses(self, time_s: Floats) -> Floats:
        """(N, 3) x m, y m, theta rad (unwrapped) at these times."""
        return self._interpolate(time_s)[:, X : THETA + 1]

    def twists(self, time_s: Floats) -> Floats:
        """(N, 2) speed forward m/s and turn rate rad/s at these times."""
        index, share, _ = self._locate(time_s)
        here, there = self.nodes[index], self.nodes[index + 1]
        u = share[:, None]
        slope = (there[:, [PATH_LENGTH, THETA]] - here[:, [PATH_LENGTH, THETA]]) * (6 * u * (1 - u) / NODE_S)
        slope += here[:, SPEED:] * (1 - 4 * u + 3 * u**2) + there[:, SPEED:] * (3 * u**2 - 2 * u)
        return slope * self._moving(time_s)[:, None]

    def travel(self, time_s: Floats) -> Floats:
        """(N, 2) distance driven m and angle turned rad since the drive began."""
        values = self._interpolate(time_s)
        return np.column_stack([values[:, PATH_LENGTH], values[:, THETA] - self.nodes[0, THETA]])

    def seen_from(self, frame: SE2) -> "Trajectory":
        """The same drive with `frame` as the origin."""
        nodes = self.nodes.copy()
        origin = frame.inverse()
        c, s = math.cos(origin.theta_rad), math.sin(origin.theta_rad)
        nodes[:, X] = origin.x_m + c * self.nodes[:, X] - s * self.nodes[:, Y]
        nodes[:, Y] = origin.y_m + s * self.nodes[:, X] + c * self.nodes[:, Y]
        nodes[:, THETA] += origin.theta_rad
        return replace(self, nodes=nodes)

    def _moving(self, time_s: Floats) -> npt.NDArray[np.bool_]:
        moving: npt.NDArray[np.bool_] = (time_s >= 0.0) & (self.repeats | (time_s <= self.duration_s))
        return moving

    def _locate(self, time_s: Floats) -> tuple[npt.NDArray[np.int64], Floats, Floats]:
        """Node before each time, share of the interval to the next, laps finished."""
        laps = np.floor(time_s / self.duration_s) if self.repeats else np.zeros_like(time_s)
        laps = np.maximum(laps, 0.0)
        place = np.clip((time_s - laps * self.duration_s) / NODE_S, 0.0, len(self.nodes) - 1)
        index = np.minimum(place.astype(np.int64), len(self.nodes) - 2)
        return index, place - index, laps

    def _interpolate(self, time_s: Floats) -> Floats:
        """(N, 4) cubic Hermite of distance, x, y, theta."""
        index, share, laps = self._locate(time_s)
        here, there = self.nodes[index], self.nodes[index + 1]
        u = share[:, None]
        values = here[:, :4] + (there[:, :4] - here[:, :4]) * (u * u * (3 - 2 * u))
        values += _slopes(here) * (NODE_S * u * (1 - u) ** 2) - _slopes(there) * (NODE_S * u * u * (1 - u))
        values[:, PATH_LENGTH] += laps * self.nodes[-1, PATH_LENGTH]
        values[:, THETA] += laps * (self.nodes[-1, THETA] - self.nodes[0, THETA])
        return values


def _slopes(nodes: Floats) -> Floats:
    """(N, 4) time derivatives of distance, x, y, theta."""
    speed, theta = nodes[:, SPEED], nodes[:, THETA]
    return np.column_stack([speed, speed * np.cos(theta), speed * np.sin(theta), nodes[:, TURN_RATE]])


def plan_drive(
    start: SE2, legs: Sequence[Leg], limits: Limits | None = None, repeats: bool = False
) -> Trajectory:
    """Turn legs into a drive. Raises ValueError where a corner does not fit its legs, and where a drive that
    repeats does not end where it began.
    """
    limits = limits or Limits()
    nodes = np.array([[0.0, start.x_m, start.y_m, start.theta_rad, 0.0, 0.0]])
    for leg in legs:
        match leg:
            case Pause(seconds):
                nodes = _append(nodes, np.repeat(nodes[-1:], 1 + round(seconds / NODE_S), axis=0))
            case Spin(turn_rad):
                nodes = _append(nodes, _spin(nodes[-1], turn_rad, limits))
            case Follow(points, corner_radius_m):
                path = _shape(tuple(nodes[-1, X : Y + 1]), points, corner_radius_m)
                facing = math.atan2(path[1, 1] - path[0, 1], path[1, 0] - path[0, 0])
                nodes = _append(nodes, _spin(nodes[-1], wrap_angle(facing - nodes[-1, THETA]), limits))
                nodes = _append(nodes, _follow(nodes[-1], path, limits))
    if len(nodes) < 2:
        nodes = np.repeat(nodes, 2, axis=0)
    if repeats:
        _check_closed(nodes)
    return Trajectory(nodes, repeats)


def drive_along(path: Floats, limits: Limits) -> Trajectory:
    """A drive from rest to rest along a smooth path (K, 2), m, as fast as the limits allow, once."""
    dx, dy = path[1] - path[0]
    begin = np.array([0.0, *path[0], math.atan2(dy, dx), 0.0, 0.0])
    return Trajectory(_follow(begin, _even(path), limits), repeats=False)


def _append(nodes: Floats, more: Floats) -> Floats:
    return np.vstack([nodes, more[1:]])


def _check_closed(nodes: Floats) -> None:
    gap = nodes[-1] - nodes[0]
    turn = wrap_angle(float(gap[THETA]))
    if max(abs(gap[X]), abs(gap[Y]), abs(turn)) > SAME_POSE:
        raise ValueError(
            f"drive ends {gap[X]:.6f} m, {gap[Y]:.6f} m, {turn:.6f} rad from its start, so it cannot repeat; "
            "let the last leg lead back"
        )


def _spin(begin: Floats, turn_rad: float, limits: Limits) -> Floats:
    """Nodes of a turn on the spot with a trapezoid of turn rate; the first is `begin`."""
    angle_rad = abs(turn_rad)
    if angle_rad < 1e-12:
        return begin[None, :]
    rate = min(limits.turn_rate_radps, math.sqrt(angle_rad * limits.turn_acceleration_radps2))
    ramp_s = rate / limits.turn_acceleration_radps2
    total_s = angle_rad / rate + ramp_s
    time_s, pace = _integer_nodes(total_s)
    rates = rate * np.clip(np.minimum(time_s, total_s - time_s) / ramp_s, 0.0, 1.0)
    turned = np.where(
        time_s < ramp_s,
        rate * time_s**2 / (2 * ramp_s),
        np.where(
            time_s < total_s - ramp_s,
            rate * (time_s - ramp_s / 2),
            angle_rad - rate * (total_s - time_s) ** 2 / (2 * ramp_s),
        ),
    )
    nodes = np.repeat(begin[None, :], len(time_s), axis=0)
    nodes[:, THETA] += math.copysign(1.0, turn_rad) * turned
    nodes[:, TURN_RATE] = math.copysign(pace, turn_rad) * rates
    return nodes


def _integer_nodes(total_s: float) -> tuple[Floats, float]:
    """Times to sample at so that a leg lasts an integer number of nodes, and the factor this slows it by."""
    count = math.ceil(total_s / NODE_S - 1e-6)  # the last digits of a sum are no node
    return np.linspace(0.0, total_s, count + 1), total_s / (count * NODE_S)


def _shape(
    begin: tuple[float, float], points: Sequence[tuple[float, float]], corner_radius_m: float
) -> Floats:
    """(K, 2) samples of the waypoints with rounded corners; curvature is continuous."""
    vertices = np.array([begin, *points])
    if (np.hypot(*np.diff(vertices, axis=0).T) < SAME_POSE).any():
        raise ValueError(f"two waypoints in a row are the same: {vertices.tolist()}; the first is the start")
    segments, where, spare_m = [], vertices[0], 0.0
    for before, corner, after in zip(vertices[:-2], vertices[1:-1], vertices[2:], strict=True):
        ahead, onward = _unit(corner - before), _unit(after - corner)
        turn = math.atan2(ahead[0] * onward[1] - ahead[1] * onward[0], float(ahead @ onward))
        tangent_m = corner_radius_m * math.tan(abs(turn) / 2)
        _check_leg(before, corner, spare_m, tangent_m)
        arc_start = corner - tangent_m * ahead
        angles = np.linspace(0.0, turn, max(2, math.ceil(abs(turn) * corner_radius_m / STEP_M)))
        left = np.array([-ahead[1], ahead[0]]) * math.copysign(1.0, turn)
        arc = arc_start + corner_radius_m * (
            np.sin(np.abs(angles))[:, None] * ahead + (1 - np.cos(angles))[:, None] * left
        )
        segments += [_line(where, arc_start), arc[:-1]]
        where, spare_m = corner + tangent_m * onward, tangent_m
    _check_leg(vertices[-2], vertices[-1], spare_m, 0.0)
    segments += [_line(where, vertices[-1]), vertices[-1:]]
    return _ease(_even(np.vstack(segments)))


def _check_leg(begin: Floats, end: Floats, spent_m: float, tangent_m: float) -> None:
    length_m = float(np.hypot(*(end - begin)))
    needed_m = spent_m + tangent_m + EASE_M
    if length_m < needed_m:
        raise ValueError(
            f"leg from {begin} to {end} is {length_m:.2f} m long, its corners need {needed_m:.2f} m; "
            "take a smaller corner radius"
        )


def _unit(vector: Floats) -> Floats:
    unit: Floats = vector / np.hypot(*vector)
    return unit


def _line(begin: Floats, end: Floats) -> Floats:
    count = max(1, math.ceil(float(np.hypot(*(end - begin))) / STEP_M))
    line: Floats = begin + np.linspace(0.0, 1.0, count, endpoint=False)[:, None] * (end - begin)
    return line


def _path_length_m(path: Floats) -> Floats:
    return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(path, axis=0).T))])


def _even(path: Floats) -> Floats:
    """Resampled at equal steps."""
    length_m = _path_length_m(path)
    even = np.linspace(0.0, length_m[-1], math.ceil(length_m[-1] / STEP_M) + 1)
    return np.column_stack([np.interp(even, length_m, path[:, 0]), np.interp(even, length_m, path[:, 1])])


def _ease(path: Floats) -> Floats:
    """Moving mean twice; the ends stay, for the path is straight there."""
    half = round(EASE_M / STEP_M) // 2
    window = np.full(2 * half + 1, 1.0 / (2 * half + 1))
    reach = np.arange(1, 2 * half + 1)[:, None]
    before = path[0] - reach[::-1] * (path[1] - path[0])
    after = path[-1] + reach * (path[-1] - path[-2])
    padded = np.vstack([before, path, after])
    kernel = np.convolve(window, window)
    eased = np.column_stack([np.convolve(padded[:, axis], kernel, mode="valid") for axis in range(2)])
    eased[0], eased[-1] = path[0], path[-1]
    return eased


def _follow(begin: Floats, path: Floats, limits: Limits) -> Floats:
    """Nodes of a drive along `path` as fast as the limits allow; the first is `begin`."""
    length_m = _path_length_m(path)
    tangent = np.gradient(path, length_m, axis=0)
    theta = np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0]))
    theta += round((begin[THETA] - theta[0]) / (2 * math.pi)) * 2 * math.pi
    curvature = np.gradient(theta, length_m)
    square = _squared_speed(length_m, np.abs(curvature), limits)
    speed = np.sqrt(square)
    time_s = np.concatenate([[0.0], np.cumsum(2 * np.diff(length_m) / (speed[1:] + speed[:-1]))])

    node_s, pace = _integer_nodes(time_s[-1])
    index = np.clip(np.searchsorted(time_s, node_s, side="right") - 1, 0, len(length_m) - 2)
    elapsed_s = node_s - time_s[index]
    acceleration = (square[index + 1] - square[index]) / (2 * (length_m[index + 1] - length_m[index]))
    node_length_m = length_m[index] + elapsed_s * (speed[index] + acceleration * elapsed_s / 2)
    node_speed = pace * np.maximum(speed[index] + acceleration * elapsed_s, 0.0)
    return np.column_stack(
        [
            begin[PATH_LENGTH] + node_length_m,
            np.interp(node_length_m, length_m, path[:, 0]),
            np.interp(node_length_m, length_m, path[:, 1]),
            np.interp(node_length_m, length_m, theta),
            node_speed,
            node_speed * np.interp(node_length_m, length_m, curvature),
        ]
    )


def _squared_speed(length_m: Floats, curvature: Floats, limits: Limits) -> Floats:
    """Highest speed squared at each sample: limits in the corner, braking before it, rest at both ends."""
    bend = np.maximum(curvature, 1e-9)
    square = np.minimum(limits.speed_mps**2, (limits.turn_rate_radps / bend) ** 2)
    square = np.minimum(square, limits.lateral_mps2 / bend)
    square[0] = square[-1] = 0.0
    gain = 2 * limits.acceleration_mps2 * length_m
    square = np.minimum.accumulate(square - gain) + gain
    square = (np.minimum.accumulate((square + gain)[::-1])[::-1]) - gain
    return np.maximum(square, 0.0)
