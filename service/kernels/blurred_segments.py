"""Orthogonal blurred segments: runs of points in a narrow band along either axis of the map."""

import numpy as np

from service.kernels.arrays import Float64_1D, Float64_2D, Int32_2D
from service.kernels.compiled import inner_kernel, kernel
from service.kernels.ordering import order_rising

NO_SEGMENT = -1


@inner_kernel
def fullest_band(across, alive, may_begin, width_m):
    """The band [across[i], across[i] + width] with the most live points, by two pointers.

    across      (N,)  float64   m, rising
    alive       (N,)  bool      points not yet in a segment
    may_begin   (N,)  bool      points a band may begin at
    Returns (first, last, count): rows [first, last) of the band, and the live points among them.
    """
    best_first, best_last, best_count = 0, 0, 0
    last, count = 0, 0
    for first in range(across.shape[0]):
        while last < across.shape[0] and across[last] <= across[first] + width_m:
            count += alive[last]
            last += 1
        if may_begin[first] and alive[first] and count > best_count:
            best_first, best_last, best_count = first, last, count
        count -= alive[first]
    return best_first, best_last, best_count


@kernel(Float64_2D, int, Float64_1D, Float64_1D, int, Int32_2D)
def segments_along(xy_map, axis, gap_m, limits, least_points, segment):
    """Blurred segments parallel to one axis of the map.

    xy_map         (N, 2) float64   m, axes of the map
    axis           int              0: parallel to x, 1: to y
    gap_m          (N,)   float64   a longer step to the next point along the axis splits a segment; of two
                                    neighbours the larger counts
    limits         (2,)   float64   width of a band, least length of a segment; m
    least_points   int              the search ends with a band of at most so many points (n)
    segment        (N, 2) int32     column `axis` out: number of the segment of each point, or NO_SEGMENT
    Returns the number of segments.
    Source: Qian et al. 2019, algorithm 1. As printed it never ends where no part of the fullest band is long
    enough; here no band may begin again within half a width of such a band.
    """
    width_m, length_m = limits[0], limits[1]
    count = xy_map.shape[0]
    order = np.empty(count, np.int64)
    across = np.empty(count)
    for i in range(count):
        across[i] = xy_map[i, 1 - axis]
    order_rising(across, order)
    alive = np.empty(count, np.bool_)
    may_begin = np.empty(count, np.bool_)
    for i in range(count):
        across[i] = xy_map[order[i], 1 - axis]
        alive[i] = True
        may_begin[i] = True
        segment[i, axis] = NO_SEGMENT
    found = 0
    for _ in range(count):  # each round removes points, or at least the start of a band
        first, last, live = fullest_band(across, alive, may_begin, width_m)
        if live <= least_points:
            break
        rows = np.empty(live, np.int64)
        along = np.empty(live)
        n = 0
        for i in range(first, last):
            if alive[i]:
                rows[n] = i
                along[n] = xy_map[order[i], axis]
                n += 1
        by_place = np.empty(live, np.int64)
        order_rising(along, by_place)
        kept = False
        begin = 0
        for n in range(live):
            here = rows[by_place[n]]
            if n + 1 < live:
                there = rows[by_place[n + 1]]
                step_m = along[by_place[n + 1]] - along[by_place[n]]
                if step_m <= max(gap_m[order[here]], gap_m[order[there]]):
                    continue
            if along[by_place[n]] - along[by_place[begin]] > length_m:
                for m in range(begin, n + 1):
                    row = rows[by_place[m]]
                    alive[row] = False
                    segment[order[row], axis] = found
                found += 1
                kept = True
            begin = n + 1
        if not kept:
            for i in range(count):
                if abs(across[i] - across[first]) < 0.5 * width_m:
                    may_begin[i] = False
            may_begin[first] = False
    return found
