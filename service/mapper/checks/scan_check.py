"""Scans that are not mapped: repeated ones, and those before the odometry of their motion."""

import numpy as np

from drivers.frames import LaserScan
from service.mapper.judgement import GAP_S

ODOMETRY_WAIT_NS = 1_000_000_000  # after a pause of all sensors: odometry arrives at 2 Hz or more
SPEED_NS = 50_000_000  # over which the motion model takes a speed from odometry
REPEATED_TRAVEL_M = 0.02  # path length after which a real scan cannot be identical


class ScanCheck:
    """Checks the scans of one laser, in the order of their arrival."""

    def __init__(self) -> None:
        self._last: LaserScan | None = None
        self._travel_m = 0.0  # since the first of equal scans

    def is_repeated(self, scan: LaserScan, travel_m: float) -> bool:
        """Whether a scan equals the previous one to the last bit although the vehicle has moved.

        Scans without returns are no evidence: a laser with nothing in range repeats them, too.

        travel_m   m   since the previous scan, as predicted
        """
        last, self._last = self._last, scan
        is_same = last is not None and last.range_m.tobytes() == scan.range_m.tobytes()
        if not is_same or not np.isfinite(scan.range_m).any():
            self._travel_m = 0.0
            return False
        self._travel_m += travel_m
        return self._travel_m > REPEATED_TRAVEL_M


class OdometryWait:
    """Drops scans after a pause of laser and odometry until odometry has measured the motion meanwhile.

    The first sample gives the motion during the pause, the next ones the present speed; an earlier scan would
    be predicted and deskewed without either.
    """

    def __init__(self) -> None:
        self._newest_ns: int | None = None  # stamp of the newest sample
        self._since_ns = 0  # stamp of the first one after the newest pause
        self._began_ns: int | None = None  # stamp of the first scan that was dropped

    def add(self, stamp_ns: int) -> None:
        if self._newest_ns is None or stamp_ns - self._newest_ns > GAP_S * 1e9:
            self._since_ns = stamp_ns
        self._newest_ns = stamp_ns

    def waits(self, stamp_ns: int, last_ns: int | None) -> bool:
        """Whether a scan is to be dropped. last_ns: of the previous scan; None: there was none."""
        if (
            self._newest_ns is None
            or last_ns is None
            or self._is_measured(stamp_ns, last_ns, self._newest_ns)
        ):
            self._began_ns = None
            return False
        if self._began_ns is None:
            self._began_ns = stamp_ns
        return stamp_ns - self._began_ns <= ODOMETRY_WAIT_NS

    def _is_measured(self, stamp_ns: int, last_ns: int, newest_ns: int) -> bool:
        if stamp_ns - last_ns <= GAP_S * 1e9:
            return True
        if self._since_ns <= last_ns:  # no pause of odometry has ended since the previous scan
            return stamp_ns - newest_ns <= GAP_S * 1e9
        return min(stamp_ns, newest_ns) - self._since_ns >= SPEED_NS
