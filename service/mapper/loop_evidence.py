"""Refused loops as they are stored, and the figures by which an operator accepts or refuses a loop."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
import numpy.typing as npt

from service.geometry import poses as se2
from service.geometry.poses import Floats

PAIR_M = 5.0  # far enough to fix the rotation, too
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

    @staticmethod
    def of(loops: Mapping[str, npt.NDArray[Any]], reason: Ints) -> "RefusedLoops":
        """Loops by their arrays in a SavedGraph, refused for reasons (R,)."""
        arrays = {f.name: loops[f"loop_{f.name}"] for f in fields(RefusedLoops)[:-1]}
        return RefusedLoops(**arrays, reason=reason)

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
        """Inverse of `arrays`. Raises KeyError."""
        return RefusedLoops(**{f.name: arrays[PREFIX + f.name] for f in fields(RefusedLoops)})


def residuals(map_poses: Floats, ends: Ints, measured: Floats) -> tuple[Floats, Floats]:
    """(N,) m and (N,) rad: residuals of loops measured as (N, 3).

    map_poses   (K, 3) of the key frames;  ends  (N, 2) indices of key frames
    """
    off = se2.between(measured, se2.between(map_poses[ends[:, 0]], map_poses[ends[:, 1]]))
    return np.hypot(off[:, 0], off[:, 1]), np.abs(off[:, 2])


def evidence(
    loops: Mapping[str, npt.NDArray[Any]],
    stamps_ns: Ints,
    map_poses: Floats,
    path_length_m: Floats,
    first_ns: int,
) -> list[dict[str, Any]]:
    """Place, times and figures of each of N loops, for JSON.

    loops      arrays as the fields of RefusedLoops; accepted ones have covariance, (N, 3, 3), and no reason
    stamps_ns, map_poses, path_length_m   (K,), (K, 3), (K,) of all key frames
    first_ns   origin of the times
    """
    ends = loops["ends"]
    off_m, off_rad = residuals(map_poses, ends, loops["measured"])
    reported: list[dict[str, Any]] = []
    for k, (of, to) in enumerate(ends.tolist()):
        reported.append(
            {
                "keyframes": [of, to],
                "stamps_ns": [str(stamps_ns[of]), str(stamps_ns[to])],
                "x_m": round(float(map_poses[to, 0]), 2),
                "y_m": round(float(map_poses[to, 1]), 2),
                "from_s": round(int(stamps_ns[of] - first_ns) / 1e9, 2),
                "back_at_s": round(int(stamps_ns[to] - first_ns) / 1e9, 2),
                "way_m": round(abs(float(path_length_m[to] - path_length_m[of])), 1),
                "points": int(loops["points"][k]),
                "on_map": round(float(loops["score"][k]), 3),
                "in_free": None if np.isnan(loops["against"][k]) else round(float(loops["against"][k]), 3),
                "off_mm": round(1e3 * float(off_m[k]), 1),
                "off_deg": round(float(np.degrees(off_rad[k])), 3),
            }
        )
        if "reason" in loops:
            reported[-1]["why"] = WORDS[loops["reason"][k]]
        else:
            covariance = loops["covariance"][k]
            widest_m2 = float(np.linalg.eigvalsh(covariance[:2, :2])[-1])
            reported[-1]["sigma_mm"] = round(1e3 * math.sqrt(max(widest_m2, 0.0)), 1)
            reported[-1]["sigma_deg"] = round(math.degrees(math.sqrt(max(covariance[2, 2], 0.0))), 3)
    return reported


def points_of(measured: Floats) -> Floats:
    """(2, 2, 2) m: two point pairs equivalent to a measured loop, (3,).

    Each point is PAIR_M from the second key frame, given in the frame of the first and of the second.
    """
    seen = np.array([[PAIR_M, 0.0], [-PAIR_M, 0.0]])
    return np.stack((se2.points_from(measured, seen), seen), axis=1)
