"""Mountings of the sensors of a recording in the plane, from its static transforms."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from drivers.mounting import MAX_OFFSET_M
from service.encoding import TF, Transform, decode_transforms
from service.errors import InputError
from service.geometry.se2 import SE2
from service.recording.mcap_reader import Readable

MAX_TILT_DEG = 10.0  # what a planar mapper can take; upside down is fine
SAME = 1e-3  # by which transforms of one mounting may differ, m and rad

Matrix = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Mounting:
    """Mounting of a sensor for a planar mapper."""

    pose_base_sensor: SE2
    upside_down: bool  # its angles run clockwise seen from above
    guessed: str = ""  # why its mounting is unknown


class MountingError(Exception):
    """Why a sensor cannot be mapped with its mounting."""


class StaticTree:
    """The static transforms of a recording: child -> parent with its 4 x 4 matrix.

    They stand in /tf_static. Where that does not lead from a sensor to the base, those edges of /tf that
    never change are taken too: tf 1 had no static topic and repeated them.

    contradicted   child -> the first transform that came after the one in use and differs from it
    """

    def __init__(self, recording: Readable) -> None:
        self._recording = recording
        self._knows_repeated = False
        self.parents: dict[str, tuple[str, Matrix]] = {}
        self.edges: dict[str, Transform] = {}
        self.contradicted: dict[str, Transform] = {}
        for transform in self._transforms(is_static=True):
            self._add(transform)

    def learn_repeated(self) -> bool:
        """Add what /tf repeats; False where that was done before, or there is nothing to add."""
        if self._knows_repeated:
            return False
        self._knows_repeated = True
        first_of: dict[str, Transform] = {}
        moving: set[str] = set()
        for transform in self._transforms(is_static=False):
            first = first_of.setdefault(transform.child, transform)
            if place_of(first) != place_of(transform):
                moving.add(transform.child)
        repeated = [
            first_of[child] for child in first_of if child not in moving and child not in self.parents
        ]
        for transform in repeated:
            self._add(transform)
        return bool(repeated)

    def _transforms(self, is_static: bool) -> Iterator[Transform]:
        names = [
            t.name
            for t in self._recording.topics
            if t.type == TF and t.name.endswith("tf_static") == is_static
        ]
        for message in self._recording.messages(names) if names else ():
            try:
                yield from decode_transforms(message.payload)
            except InputError:  # one damaged message does not change the mountings
                continue

    def _add(self, transform: Transform) -> None:
        if not np.isfinite([*transform.translation_m, *transform.rotation_wxyz]).all():
            return
        used = self.edges.setdefault(transform.child, transform)
        if used is transform:
            self.parents[transform.child] = (transform.frame, _matrix(transform))
        elif used.frame != transform.frame or not np.allclose(_matrix(used), _matrix(transform), atol=SAME):
            self.contradicted.setdefault(transform.child, transform)

    def chain(self, frame: str) -> dict[str, Matrix]:
        """Every frame above, with the matrix that takes coordinates of `frame` to it."""
        matrix, above = np.eye(4), {frame: np.eye(4)}
        while frame in self.parents:
            frame, step = self.parents[frame]
            if frame in above:  # a loop in a broken tree
                break
            matrix = step @ matrix
            above[frame] = matrix
        return above


def place_of(transform: Transform) -> tuple[str, tuple[float, ...], tuple[float, ...]]:
    """A transform without its time: equal where nothing has moved."""
    return transform.frame, transform.translation_m, transform.rotation_wxyz


def in_words(transform: Transform) -> str:
    """ "base_link to laser: x 0.2, y 0, z 0.25 m, yaw 90 deg"."""
    x_m, y_m, z_m = transform.translation_m
    matrix = _matrix(transform)
    yaw_deg = math.degrees(math.atan2(matrix[1, 0], matrix[0, 0]))
    place = f"x {x_m:.3g}, y {y_m:.3g}, z {z_m:.3g} m, yaw {yaw_deg:.3g} deg"
    return f"{transform.frame} to {transform.child}: {place}"


def _matrix(transform: Transform) -> Matrix:
    w, x, y, z = np.array(transform.rotation_wxyz) / (math.hypot(*transform.rotation_wxyz) or 1.0)
    matrix = np.eye(4)
    matrix[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    matrix[:3, 3] = transform.translation_m
    return matrix


def refuse_far(matrix: Matrix, base: str) -> None:
    """Raises MountingError where no vehicle is as large."""
    away_m = float(np.abs(matrix[:3, 3]).max())
    if not away_m <= MAX_OFFSET_M:
        raise MountingError(f"{away_m:.3g} m away from {base}; at most {MAX_OFFSET_M:.0f} m along an axis")


def planar_mounting(tree: StaticTree, bases: Sequence[str], sensor_frame: str) -> Mounting | None:
    """None where the tree does not lead from the sensor to one of the bases. Raises MountingError."""
    above = tree.chain(sensor_frame)
    base = next((name for name in bases if name in above), None)
    if base is None:
        return planar_mounting(tree, bases, sensor_frame) if tree.learn_repeated() else None
    matrix = above[base]
    refuse_far(matrix, base)
    edge = tree.edges.get(sensor_frame)
    if edge is not None and edge.frame == base and (edge.is_planar or edge.is_upside_down):
        return Mounting(edge.pose, edge.is_upside_down)  # exactly as the live mapper had it
    up = float(np.clip(matrix[2, 2], -1.0, 1.0))
    tilt_deg = math.degrees(math.acos(abs(up)))
    if tilt_deg > MAX_TILT_DEG:
        raise MountingError(
            f"tilted by {tilt_deg:.0f} deg against {base}; at most {MAX_TILT_DEG:.0f} can be mapped"
        )
    yaw_rad = math.atan2(matrix[1, 0], matrix[0, 0])
    return Mounting(SE2(float(matrix[0, 3]), float(matrix[1, 3]), yaw_rad), upside_down=up < 0.0)
