"""Figures of a loop closure, by which an operator accepts or refuses it."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from service.geometry import poses as se2
from service.geometry.poses import Floats
from service.mapper.refused_loops import WORDS, Ints

PAIR_M = 5.0  # far enough to fix the rotation, too


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
