"""What a fake Hokuyo laser measures in one sweep, coded as the device codes it. No I/O, no protocol."""

import math

import numpy as np

from drivers.hokuyo_utm30lx.scans import MAX_ECHOES, NO_ECHO, Ints, Scan, ScanRequest
from simulators.device import Beams, Sweep, SweepSource
from simulators.hokuyo_setup import Replies

NEAR_LIMIT_CODE = 4
FULL_INTENSITY = 16_000  # raw; a recorded unit gave 1744 to 16219


class Optics:
    """Casts the rays of a sweep and codes their echoes."""

    def __init__(self, source: SweepSource, replies: Replies) -> None:
        self._source = source
        self._replies = replies

    def measure(self, request: ScanRequest, step_0_ns: int, step_ns: float, stamp_ms: int) -> Scan:
        """One sweep; step_0_ns is when the mirror passes step 0, host ns."""
        step_rad = 2.0 * math.pi / self._replies.steps_per_turn
        beams = Beams(
            step_0_ns + round(request.first_step * step_ns),
            round(step_ns),
            (request.first_step - self._replies.front_step) * step_rad,
            step_rad,
            request.last_step - request.first_step + 1,
        )
        distance_mm, intensity = self._code(self._source.sweep(beams))
        if request.multi_echo:  # (3, N), though no beam meets anything behind what it hits
            none = np.full((MAX_ECHOES - 1, beams.count), NO_ECHO, np.int32)
            distance_mm, intensity = np.vstack([distance_mm, none]), np.vstack([intensity, none])
        distance_mm, intensity = self._clustered(distance_mm, intensity, max(request.cluster, 1))
        return Scan(request, stamp_ms, distance_mm, intensity if request.with_intensity else distance_mm[:0])

    def _code(self, sweep: Sweep) -> tuple[Ints, Ints]:
        """(1, N) distance in mm or an error code, and raw intensity."""
        seen, replies = ~np.isnan(sweep.range_m), self._replies
        distance_mm = np.full(sweep.range_m.shape, replies.no_return_mm, dtype=np.int32)
        distance_mm[seen] = np.rint(sweep.range_m[seen] * 1000.0)
        distance_mm[seen & (distance_mm < replies.distance_min_mm)] = NEAR_LIMIT_CODE
        distance_mm[seen & (distance_mm >= replies.distance_max_mm)] = replies.no_return_mm
        intensity = np.where(seen, np.rint(sweep.intensity * FULL_INTENSITY), 0).astype(np.int32)
        return distance_mm[np.newaxis], intensity[np.newaxis]

    def _clustered(self, distance_mm: Ints, intensity: Ints, cluster: int) -> tuple[Ints, Ints]:
        """Of each `cluster` neighbours the nearest one with a distance, else the first one's code."""
        if cluster == 1:
            return distance_mm, intensity
        beams = distance_mm.shape[1]
        groups = -(-beams // cluster)
        columns = np.minimum(np.arange(groups * cluster), beams - 1).reshape(groups, cluster)
        first = distance_mm[0][columns]
        is_distance = first >= self._replies.distance_min_mm
        nearest = np.where(is_distance, first, np.iinfo(np.int32).max).argmin(axis=1)
        chosen = columns[np.arange(groups), nearest]
        return distance_mm[:, chosen], intensity[:, chosen]
