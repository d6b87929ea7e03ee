"""A corridor: which places of it can be distinguished, and which are not."""

import math
from itertools import pairwise

import numpy as np

from service.geometry import poses as se2
from service.geometry.se2 import SE2
from service.mapper.graph.model.keyframe_list import KeyframeList, LoopsConfig
from service.mapper.graph.relocalise.detached_search import DetachedSearch
from service.mapper.graph.relocalise.place_search import is_same_pose
from tests.service.mapper.graph.key_frames import Walls, append

LENGTH_M = 70.0


def corridor(niche_at_m: tuple[float, ...] = ()) -> Walls:
    """Two walls, closed at both ends, with niches in one of them."""
    points = [(0.0, 1.2)]
    for x_m in niche_at_m:
        points += [(x_m, 1.2), (x_m, 2.4), (x_m + 1.6, 2.4), (x_m + 1.6, 1.2)]
    points += [(LENGTH_M, 1.2), (LENGTH_M, -1.2), (0.0, -1.2), (0.0, 1.2)]
    return [(*a, *b) for a, b in pairwise(points)]


def mapped(walls: Walls) -> tuple[KeyframeList, np.random.Generator]:
    noise, keyframes = np.random.default_rng(5), KeyframeList()
    for x_m in np.arange(1.0, LENGTH_M - 1.0, 0.5):
        append(keyframes, within(walls, x_m), SE2(x_m, 0.0, 0.0), 0, noise)
    return keyframes, noise


def within(walls: Walls, x_m: float, reach_m: float = 9.0) -> Walls:
    """What a laser of so short a reach can see."""
    low, high = x_m - reach_m, x_m + reach_m
    near = []
    for x0, y0, x1, y1 in walls:
        if max(x0, x1) >= low and min(x0, x1) <= high:
            near.append((float(np.clip(x0, low, high)), y0, float(np.clip(x1, low, high)), y1))
    return near


def looked_for(walls: Walls, pose: SE2) -> tuple[DetachedSearch, tuple[np.ndarray, object] | None]:
    keyframes, noise = mapped(walls)
    known = np.arange(keyframes.count)
    own = append(keyframes, within(walls, pose.x_m), pose, 1, noise)
    search = DetachedSearch(LoopsConfig(), keyframes)
    return search, search.best_of(search.places_of([own], own, known))


def test_along_bare_walls_no_place_is_accepted():
    """Each cell of a block of the search fits as well as the one that it gives."""
    search, best = looked_for(corridor(), SE2(33.0, 0.3, 0.2))
    assert best is None
    assert len(search.possible) == 2


def test_a_niche_fixes_the_position_along_a_corridor():
    pose = SE2(33.0, 0.3, 0.2)
    _, best = looked_for(corridor((13.0, 34.0, 35.9)), pose)
    assert best is not None
    assert is_same_pose(best[0], np.array([pose.x_m, pose.y_m, pose.theta_rad]))
    away = se2.between(np.array([pose.x_m, pose.y_m, pose.theta_rad]), best[0])
    assert math.hypot(away[0], away[1]) < 0.03
