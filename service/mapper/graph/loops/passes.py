"""Selects the key frames of earlier passes at which loops are searched."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from service.geometry.poses import Floats
from service.mapper.graph.model.keyframe_list import KeyframeList
from service.mapper.graph.model.loops import Loop, far_from_loops
from service.mapper.graph.model.loops_config import LoopsConfig

PASSES = 4  # the nearest ones, per search
MAX_STRETCHES = 1000  # searched again at the finish, 10 s and more; of longer drives those without loops


def passes_to_search(
    path_length_m: Floats, near: npt.NDArray[np.int64], away_m: Floats, reach_m: Floats, place_m: float
) -> list[int]:
    """The nearest key frame of each pass; where the window is wider than a sub-map, others beside it.

    path_length_m, away_m, reach_m   (N,) of all key frames: path up to each, distance, half the window, m
    near      (K,) indices of loop candidates, ascending
    place_m   half the path length of a sub-map
    """
    candidates = nearest_of_passes(path_length_m, near, away_m, place_m)[:PASSES]
    for k in list(candidates):
        aside = 1
        while aside * place_m <= reach_m[k]:
            for at_m in (path_length_m[k] - aside * place_m, path_length_m[k] + aside * place_m):
                other = int(near[np.argmin(np.abs(path_length_m[near] - at_m))])
                if abs(path_length_m[other] - at_m) < 0.5 * place_m and other not in candidates:
                    candidates.append(other)
            aside += 1
    return candidates


def nearest_of_passes(
    path_length_m: Floats, near: npt.NDArray[np.int64], away_m: Floats, place_m: float
) -> list[int]:
    """The nearest key frame of each pass, the nearest pass first; arguments as of passes_to_search."""
    if not len(near):
        return []
    breaks = np.flatnonzero(np.diff(path_length_m[near]) > place_m) + 1
    best = [int(run[np.argmin(away_m[run])]) for run in np.split(near, breaks)]
    return sorted(best, key=lambda k: (away_m[k], k))


def stretches_to_search(keyframes: KeyframeList, loops: Sequence[Loop], config: LoopsConfig) -> list[int]:
    """The last key frame of each stretch of the session to search at the finish."""
    path_length_m = keyframes.path_length_m
    at_m = np.arange(
        config.place_m + float(path_length_m[keyframes.stored]), path_length_m[-1], config.search_every_m
    )
    if len(at_m) > MAX_STRETCHES:
        tied_m = path_length_m[[loop.to for loop in loops]] + 0.5 * config.place_m  # ends of the queries
        at_m = far_from_loops(at_m, tied_m, config.search_every_m)
    last: list[int] = np.unique(np.searchsorted(path_length_m, at_m)).tolist()  # some may be removed
    return last
