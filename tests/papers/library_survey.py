"""Survey of the library of the simulator: lines of its plan, and corners."""

import numpy as np

from simulators.trajectory import Floats
from simulators.world import Plan, Point
from simulators.worlds.library import (
    CABINET_M,
    CASE_WIDTH_M,
    CASE_X_M,
    CASE_Y_M,
    HEIGHT_M,
    OFFICES_M,
    START_M,
    WIDTH_M,
    draw_structure,
)


def library_structure() -> Floats:
    """(S, 4) lines of the plan, in the frame of the start with heading 0: cases, no books."""
    plan = Plan()
    draw_structure(plan)
    for x in CASE_X_M:
        for low, high in CASE_Y_M:
            plan.box((x, (low + high) / 2), (CASE_WIDTH_M, high - low))
    west, east, y = CABINET_M
    plan.line((west, y), (east, y))
    segments: Floats = np.array(plan.segments) - np.array([*START_M, *START_M])
    return segments


def library_check_points() -> Floats:
    """(18, 2) surveyed corners, in the frame of the start with heading 0.

    4 of the hall, 4 of the offices, 8 of bookcases' ends, 2 where the cabinet ends.
    """
    west, south, east, north = OFFICES_M
    half = CASE_WIDTH_M / 2
    points: list[Point] = [(0, 0), (WIDTH_M, 0), (WIDTH_M, HEIGHT_M), (0, HEIGHT_M)]
    points += [(west, south), (east, south), (east, north), (west, north)]
    low, high = CASE_Y_M[0][0], CASE_Y_M[1][1]
    for x in (CASE_X_M[0], CASE_X_M[2], CASE_X_M[3], CASE_X_M[5]):
        points += [(x - half, low), (x + half, high)]
    points += [(CABINET_M[0], CABINET_M[2]), (CABINET_M[1], CABINET_M[2])]
    places: Floats = np.array(points, dtype=np.float64) - START_M
    return places
