"""Usable GNSS fixes, each with the odometry pose at its moment."""

import math
from collections import Counter, deque
from dataclasses import dataclass
from typing import NamedTuple

from drivers.frames import GnssFix
from service.estimator.motion import PAUSE_NS
from service.geometry.se2 import SE2

MAX_FIX_SIGMA_M = 10.0  # of the worse direction: fixes with more are dropped
REMEMBERED_NS = 5_000_000_000  # of scans: a fix arrives after the scans of its moment
MAX_FIXES_WAITING = 256  # fixes that wait for a scan
SPACING_M = 5.0  # between two kept fixes: closer ones are redundant
FROZEN_M = 1.0  # path length over which a receiver cannot repeat a position exactly


@dataclass(frozen=True, slots=True)
class PlacedFix:
    """A fix, and the odometry pose at its moment. Can be pickled.

    keyframe     index of the newest key frame at that moment
    antenna_xy_m   in the base frame
    covariance   m^2: east, east north, north
    """

    stamp_ns: int
    keyframe: int
    pose_odom_base: SE2
    antenna_xy_m: tuple[float, float]
    latitude_deg: float
    longitude_deg: float
    height_m: float
    covariance: tuple[float, float, float]


class _Scan(NamedTuple):
    stamp_ns: int
    pose_odom_base: SE2
    keyframe: int  # index of the newest key frame after it; -1: none


class FixTrack:
    """Takes fixes and scans in order of arrival; returns fixes with poses, one per SPACING_M.

    Only fixes of the first receiver are used. One without a height (NaN, as in sensor_msgs/NavSatFix) gets
    that of the newest fix with one, else 0: an error h of the height moves a fix in the plane by d h / R,
    where d is its distance from the origin.
    """

    def __init__(self) -> None:
        self._receiver: str | None = None
        self._last_ns = -(2**63)
        self._scans: deque[_Scan] = deque()
        self._waiting: deque[tuple[GnssFix, tuple[float, float]]] = deque()
        self._placed: list[PlacedFix] = []
        self._reported: tuple[float, float, SE2] | None = None  # newest distinct position, and the pose at it
        self._kept: SE2 | None = None  # pose_odom_base of the newest kept fix
        self._height_m = 0.0  # of the newest fix with a height
        self._counts: Counter[str] = Counter()

    def add_fix(self, fix: GnssFix, antenna_xy_m: tuple[float, float]) -> str:
        """Add a fix; returns its counter: "fixes_taken", or the reason it was dropped."""
        if self._receiver is None:
            self._receiver = fix.sensor
        if fix.sensor != self._receiver:
            return "fixes_of_another_receiver"
        if fault := _fault(fix):
            return fault
        if fix.stamp_ns <= self._last_ns:
            return "fixes_out_of_order"
        self._last_ns = fix.stamp_ns
        if len(self._waiting) == MAX_FIXES_WAITING:
            self._waiting.popleft()
            self._counts["fixes_without_scans"] += 1
        self._waiting.append((fix, antenna_xy_m))
        self._place_waiting()
        return "fixes_taken"

    def add_scan(self, stamp_ns: int, pose_odom_base: SE2, keyframe: int) -> None:
        """keyframe: index of the newest one, including this scan; -1: none."""
        self._scans.append(_Scan(stamp_ns, pose_odom_base, keyframe))
        while stamp_ns - self._scans[0].stamp_ns > REMEMBERED_NS and len(self._scans) > 2:
            self._scans.popleft()
        if self._waiting:
            self._place_waiting()

    def take(self) -> list[PlacedFix]:
        """Fixes with poses since the last call, by ascending stamps."""
        placed, self._placed = self._placed, []
        return placed

    def take_counts(self) -> Counter[str]:
        """Counts since the last call of fixes dropped after they were taken, by reason."""
        counts, self._counts = self._counts, Counter()
        return counts

    def _place_waiting(self) -> None:
        while self._waiting and self._scans and self._waiting[0][0].stamp_ns <= self._scans[-1].stamp_ns:
            fix, antenna_xy_m = self._waiting.popleft()
            after = next(k for k, scan in enumerate(self._scans) if scan.stamp_ns >= fix.stamp_ns)
            b = self._scans[after]
            a = b if b.stamp_ns == fix.stamp_ns or after == 0 else self._scans[after - 1]
            if not a.stamp_ns <= fix.stamp_ns or b.stamp_ns - a.stamp_ns > PAUSE_NS or a.keyframe < 0:
                self._counts["fixes_without_scans"] += 1
                continue
            here = _between(a, b, fix.stamp_ns)
            if fault := self._is_redundant(fix, here):
                self._counts[fault] += 1
                continue
            self._kept = here
            if math.isnan(fix.altitude_m):
                self._counts["fixes_without_height"] += 1
            else:
                self._height_m = fix.altitude_m
            self._placed.append(
                PlacedFix(
                    fix.stamp_ns,
                    a.keyframe,
                    here,
                    antenna_xy_m,
                    fix.latitude_deg,
                    fix.longitude_deg,
                    self._height_m,
                    (fix.covariance[0], fix.covariance[1], fix.covariance[4]),
                )
            )

    def _is_redundant(self, fix: GnssFix, here: SE2) -> str:
        """Counter of a fix that adds no information to those before; "" if it does."""
        reported = self._reported
        if reported is not None and reported[:2] == (fix.latitude_deg, fix.longitude_deg):
            if _apart_m(reported[2], here) > FROZEN_M:
                return "fixes_frozen"
        else:
            self._reported = (fix.latitude_deg, fix.longitude_deg, here)
        if self._kept is not None and _apart_m(self._kept, here) < SPACING_M:
            return "fixes_thinned"
        return ""


def _fault(fix: GnssFix) -> str:
    """Counter of the fault of a single fix; "" if it has none."""
    if fix.status < 0 or not all(map(math.isfinite, (fix.latitude_deg, fix.longitude_deg))):
        return "fixes_without_position"
    is_on_earth = abs(fix.latitude_deg) <= 90.0 and abs(fix.longitude_deg) <= 180.0
    if not is_on_earth or math.isinf(fix.altitude_m):
        return "fixes_impossible"
    east, cross, north = fix.covariance[0], fix.covariance[1], fix.covariance[4]
    # In a form that rejects NaN.
    if not (0.0 < east < math.inf and 0.0 < north < math.inf and cross * cross < east * north):
        return "fixes_without_covariance"
    larger = 0.5 * (east + north) + math.hypot(0.5 * (east - north), cross)  # eigenvalue
    return "fixes_too_poor" if larger > MAX_FIX_SIGMA_M**2 else ""


def _between(a: _Scan, b: _Scan, stamp_ns: int) -> SE2:
    """Pose of the base between two scans, at a constant twist."""
    if a.stamp_ns == b.stamp_ns:
        return a.pose_odom_base
    share = (stamp_ns - a.stamp_ns) / (b.stamp_ns - a.stamp_ns)
    forward_m, left_m, turn_rad = a.pose_odom_base.between(b.pose_odom_base).log()
    return a.pose_odom_base @ SE2.exp(share * forward_m, share * left_m, share * turn_rad)


def _apart_m(a: SE2, b: SE2) -> float:
    return math.hypot(b.x_m - a.x_m, b.y_m - a.y_m)
