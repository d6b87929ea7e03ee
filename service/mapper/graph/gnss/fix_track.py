"""GNSS fixes on the way of the base: those that can be used, each with where odometry had the base then."""

import math
from collections import Counter, deque
from dataclasses import dataclass
from typing import NamedTuple

from drivers.frames import GnssFix
from service.geometry.se2 import SE2

MAX_FIX_SIGMA_M = 10.0  # of the worse direction: a fix that says it is worse anchors nothing
MAX_GAP_NS = 1_000_000_000  # between two scans that a fix lies between: nobody knows the way in a longer one
REMEMBERED_NS = 5_000_000_000  # of scans: a fix comes later than the scans of its moment
MAX_FIXES_WAITING = 256  # fixes for a scan to come
SPACING_M = 5.0  # between two fixes that are kept: the next one says hardly more, and standing says nothing
FROZEN_M = 1.0  # way over which no receiver gives one position to the last digit


@dataclass(frozen=True, slots=True)
class PlacedFix:
    """A fix, and where odometry had the base at its moment. Can be pickled.

    keyframe     the newest one at that moment, counted from 0
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
    keyframe: int  # the newest one after it; -1: there is none


class FixTrack:
    """Takes fixes and scans in order of arrival, gives fixes placed, one each 5 m.

    Fixes of one receiver, the first that is heard: errors of two would have to be told apart. One without a
    height (NaN, as sensor_msgs/NavSatFix has it) gets that of the newest with one, else 0: h of height
    displace a fix on the plane by d h / R, where d is its distance from the origin.
    """

    def __init__(self) -> None:
        self._receiver: str | None = None
        self._last_ns = -(2**63)
        self._scans: deque[_Scan] = deque()
        self._waiting: deque[tuple[GnssFix, tuple[float, float]]] = deque()
        self._placed: list[PlacedFix] = []
        self._reported: tuple[float, float, SE2] | None = None  # newest position told, and where that began
        self._kept: SE2 | None = None  # pose_odom_base of the newest fix that was kept
        self._height_m = 0.0  # of the newest fix that had one
        self._counts: Counter[str] = Counter()

    def add_fix(self, fix: GnssFix, antenna_xy_m: tuple[float, float]) -> str:
        """The counter it falls under: "fixes_taken", or what is wrong with it."""
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
        """keyframe: the newest one, this scan among them; -1: there is none."""
        self._scans.append(_Scan(stamp_ns, pose_odom_base, keyframe))
        while stamp_ns - self._scans[0].stamp_ns > REMEMBERED_NS and len(self._scans) > 2:
            self._scans.popleft()
        self._place_waiting()

    def take(self) -> list[PlacedFix]:
        """Those placed since the last call, by rising stamps."""
        placed, self._placed = self._placed, []
        return placed

    def take_counts(self) -> Counter[str]:
        """What came to nothing after it was taken, since the last call: fixes by reason."""
        counts, self._counts = self._counts, Counter()
        return counts

    def _place_waiting(self) -> None:
        while self._waiting and self._scans and self._waiting[0][0].stamp_ns <= self._scans[-1].stamp_ns:
            fix, antenna_xy_m = self._waiting.popleft()
            after = next(k for k, scan in enumerate(self._scans) if scan.stamp_ns >= fix.stamp_ns)
            b = self._scans[after]
            a = b if b.stamp_ns == fix.stamp_ns or after == 0 else self._scans[after - 1]
            if not a.stamp_ns <= fix.stamp_ns or b.stamp_ns - a.stamp_ns > MAX_GAP_NS or a.keyframe < 0:
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
        """The counter of a fix that tells no more than those before; "" if it does."""
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
    """The counter of what is wrong with a fix taken by itself; "" if nothing is."""
    if fix.status < 0 or not all(map(math.isfinite, (fix.latitude_deg, fix.longitude_deg))):
        return "fixes_without_position"
    is_on_earth = abs(fix.latitude_deg) <= 90.0 and abs(fix.longitude_deg) <= 180.0
    if not is_on_earth or math.isinf(fix.altitude_m):
        return "fixes_impossible"
    east, cross, north = fix.covariance[0], fix.covariance[1], fix.covariance[4]
    # Written so that NaN is refused.
    if not (0.0 < east < math.inf and 0.0 < north < math.inf and cross * cross < east * north):
        return "fixes_without_covariance"
    larger = 0.5 * (east + north) + math.hypot(0.5 * (east - north), cross)  # eigenvalue
    return "fixes_too_poor" if larger > MAX_FIX_SIGMA_M**2 else ""


def _between(a: _Scan, b: _Scan, stamp_ns: int) -> SE2:
    """Where the base was between two scans, at a constant twist."""
    if a.stamp_ns == b.stamp_ns:
        return a.pose_odom_base
    share = (stamp_ns - a.stamp_ns) / (b.stamp_ns - a.stamp_ns)
    forward_m, left_m, turn_rad = (a.pose_odom_base.inverse() @ b.pose_odom_base).log()
    return a.pose_odom_base @ SE2.exp(share * forward_m, share * left_m, share * turn_rad)


def _apart_m(a: SE2, b: SE2) -> float:
    return math.hypot(b.x_m - a.x_m, b.y_m - a.y_m)
