"""Loops that were measured but not accepted, as they are stored, with the reason."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
import numpy.typing as npt

from service.geometry.poses import Floats

Ints = npt.NDArray[np.int64]

TOO_FEW_POINTS, IN_FREE_SPACE, NOT_SUPPORTED, CONTRADICTED, BY_HAND, TOO_FAR = range(6)
WORDS = (
    "too few of its points lie on the map",
    "too many of its points lie in free space of the map",
    "no other loop nearby agrees with it",
    "the rest of the graph contradicts it",
    "refused by the operator",
    "it deviates from the path by more than the path's drift",
)
PREFIX = "refused_"  # of the array names in a file


@dataclass(frozen=True, slots=True, eq=False)
class RefusedLoops:
    """R refused loops; arrays as those of the accepted ones."""

    ends: Ints = field(default_factory=lambda: np.zeros((0, 2), np.int64))  # (R, 2) key frames
    measured: Floats = field(default_factory=lambda: np.zeros((0, 3)))  # (R, 3) second in first
    score: Floats = field(default_factory=lambda: np.zeros(0))  # (R,) inlier ratio
    points: Ints = field(default_factory=lambda: np.zeros(0, np.int64))  # (R,) evaluated
    against: Floats = field(default_factory=lambda: np.zeros(0))  # (R,) share in free space; NaN: unknown
    reason: Ints = field(default_factory=lambda: np.zeros(0, np.int64))  # (R,) index in WORDS

    def problem(self, keyframes: int) -> str:
        """Why the arrays do not fit a graph of so many key frames; "" if they fit."""
        count = len(self.ends)
        for f in fields(self):
            shape = {"ends": (count, 2), "measured": (count, 3)}.get(f.name, (count,))
            if getattr(self, f.name).shape != shape:
                return f"{PREFIX}{f.name} has the shape {getattr(self, f.name).shape}, expected {shape}"
        if count and (self.ends.min() < 0 or self.ends.max() >= keyframes):
            return f"{PREFIX}ends names key frames that are not among the {keyframes} here"
        if count and (self.reason.min() < 0 or self.reason.max() >= len(WORDS)):
            return f"{PREFIX}reason has an index outside 0..{len(WORDS) - 1}"
        return ""

    def chosen(self, which: Ints) -> "RefusedLoops":
        return RefusedLoops(*(getattr(self, f.name)[which] for f in fields(self)))

    def followed_by(self, other: "RefusedLoops") -> "RefusedLoops":
        return RefusedLoops(
            *(np.concatenate((getattr(self, f.name), getattr(other, f.name))) for f in fields(self))
        )

    def renumbered(self, number: Ints, is_kept: npt.NDArray[np.bool_]) -> "RefusedLoops":
        """The loops between kept key frames, with the new indices (N,) of these."""
        left = self.chosen(np.flatnonzero(is_kept[self.ends].all(axis=1)))
        return RefusedLoops(number[left.ends], *(getattr(left, f.name) for f in fields(left)[1:]))

    def by_field(self) -> dict[str, npt.NDArray[Any]]:
        return {f.name: getattr(self, f.name) for f in fields(self)}

    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        return {PREFIX + name: array for name, array in self.by_field().items()}

    @staticmethod
    def from_arrays(arrays: Mapping[str, npt.NDArray[Any]]) -> "RefusedLoops":
        """Inverse of `arrays`; a file of format 2 has none. Raises KeyError."""
        if not any(name.startswith(PREFIX) for name in arrays):
            return RefusedLoops()
        return RefusedLoops(**{f.name: arrays[PREFIX + f.name] for f in fields(RefusedLoops)})
