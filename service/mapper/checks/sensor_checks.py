"""Checks of the sensors before and after a match: whether a scan is mapped, and why not."""

from collections import Counter
from typing import NamedTuple

import numpy as np

from drivers.frames import LaserScan, OdometrySample
from service.estimator.motion import PAUSE_NS, Measurement, Prediction
from service.geometry.se2 import SE2
from service.kernels.tracks import SPEED_WINDOW_NS
from service.mapper.checks.mounting_check import MountingCheck, centre
from service.mapper.checks.odometry_mounting import OdometryMounting
from service.mapper.checks.stamp_check import StampChecks
from service.mapper.components import Match
from service.mapper.judgement import GAP_S
from service.outputs import Reason, State

CONFIRMED_NS = 500_000_000  # for which an inlier scan confirms the pose
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
    """Drops scans after a pause of laser and odometry until odometry has measured the motion meanwhile,
    for PAUSE_NS at most.

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
            last_ns is None
            or stamp_ns - last_ns <= GAP_S * 1e9
            or self._newest_ns is None
            or self._is_measured(stamp_ns, last_ns, self._newest_ns)
        ):
            self._began_ns = None
            return False
        if self._began_ns is None:
            self._began_ns = stamp_ns
        return stamp_ns - self._began_ns <= PAUSE_NS

    def _is_measured(self, stamp_ns: int, last_ns: int, newest_ns: int) -> bool:
        if self._since_ns <= last_ns:  # no pause of odometry has ended since the previous scan
            return stamp_ns - newest_ns <= GAP_S * 1e9
        return min(stamp_ns, newest_ns) - self._since_ns >= SPEED_WINDOW_NS


class Verdict(NamedTuple):
    """State of the pose at a scan, and why."""

    state: State
    reason: Reason


class _Laser:
    def __init__(self) -> None:
        self.repeats = ScanCheck()
        self.mounting = MountingCheck()
        self.confirmed_ns: int | None = None  # stamp of its newest scan with returns; None: that one was lost
        self.travel_m = 0.0  # of the vehicle, up to its newest scan


class _Lasers(dict[str, _Laser]):
    """By name. One that joins others is compared with their map first."""

    def __missing__(self, sensor: str) -> _Laser:
        laser = _Laser()
        if self:
            laser.mounting.begin()
        self[sensor] = laser
        return laser


class SensorChecks:
    """All checks of lasers and odometry against each other. Calls come in the order of scans.

    counters    of dropped scans, by laser
    """

    def __init__(self, counters: Counter[str]) -> None:
        self._counters = counters
        self.lasers = _Lasers()
        self.odometry_wait = OdometryWait()
        self._odometry_mounting = OdometryMounting()
        self._stamps = StampChecks()
        self._travel_m = 0.0  # as predicted, from scan to scan
        self._matched = ""  # laser of the newest scan that was matched

    def add_odometry(self, sample: OdometrySample) -> None:
        self.odometry_wait.add(sample.stamp_ns)
        self._odometry_mounting.add_odometry(sample)

    def refuse(self, scan: LaserScan, at_ns: int, travel_m: float) -> Verdict | None:
        """Reason not to match a scan; None: it is matched. travel_m: m since the previous scan, predicted."""
        laser = self.lasers[scan.sensor]
        self._travel_m += travel_m
        moved_m, laser.travel_m = self._travel_m - laser.travel_m, self._travel_m
        if not laser.repeats.is_repeated(scan, moved_m):
            return None
        self._counters["scans_repeated"] += 1
        reason = Reason(
            "laser_repeats",
            f"{scan.sensor}: identical scans although the vehicle moves; has the laser stopped measuring?",
        )
        return Verdict("degraded" if self._confirmed_by_another(scan.sensor, at_ns) else "lost", reason)

    def _refine_mounting(self, sensor: str, predicted: Prediction, measured: Measurement) -> None:
        """Correct the mounting of a laser by a scan that was matched right after one of another laser."""
        if measured.gap is not None or measured.segment_noise is not None:  # a jump
            return
        if self.lasers[sensor].mounting.refine(predicted, measured):
            self._counters[f"mounting_corrected_{sensor}"] += 1
            centre(laser.mounting for laser in self.lasers.values())

    def comparison_prior(self, sensor: str, at_ns: int, predicted: Prediction) -> Prediction | None:
        """Where to search a scan of a laser whose mounting or stamps are in doubt; None: it is mapped.

        Such a scan has no effect on pose and map.
        """
        if len(self.lasers) == 1:
            return None
        mounting = self.lasers[sensor].mounting
        is_in_doubt = not mounting.is_right or self._stamps.fault_of(sensor)
        if not mounting.fault and not (is_in_doubt and self._confirmed_by_another(sensor, at_ns)):
            return None
        self._counters[f"scans_compared_{sensor}"] += 1
        return mounting.search_prior(predicted, self._stamps.late_s(sensor))

    def compare(self, match: Match, at_ns: int, prior: Prediction, usual: Verdict) -> Verdict:
        """Verdict on a scan matched from `comparison_prior`. usual: of the newest mapped scan."""
        sensor = match.points.scan.sensor
        mounting = self.lasers[sensor].mounting
        if match.measured is not None and match.state != "lost":
            self._add_heading(sensor, at_ns, match.measured.pose_odom_base)
            if not mounting.is_right:
                mounting.add(prior, match.measured, match.advantage)
        elif match.is_contradicted:
            mounting.miss()
        fault = self._stamps.fault_of(sensor) or mounting.fault
        is_alone = not self._confirmed_by_another(sensor, at_ns)
        if not fault or not (is_alone or usual.state == "ok"):
            return usual
        return Verdict("lost" if is_alone else "degraded", fault.reworded(f"{sensor} {fault}"))

    def judge(
        self, match: Match, few: Reason, predicted: Prediction, at_ns: int, motion_fault: Reason
    ) -> Match | Verdict:
        """The match with the state that the sensors allow; or the reason why it is not mapped.

        few             by too_few
        motion_fault    of a motion source, by the motion model
        """
        sensor, measured = match.points.scan.sensor, match.measured
        if measured is not None:
            before, self._matched = self._matched, sensor
            if before not in ("", sensor):
                self._refine_mounting(sensor, predicted, measured)
        if few:
            self._counters[f"scans_blind_{sensor}"] += 1
        if match.state == "lost":
            self._odometry_mounting.interrupt()
            self._stamps.interrupt()
            if other := self._confirmed_by_another(sensor, at_ns):
                return self._contradicted(match, other, few)
        if not few:  # else it is no evidence for or against the pose
            self.lasers[sensor].confirmed_ns = at_ns if match.state != "lost" else None
        if match.state != "ok":
            return match
        if len(self.lasers) > 1:
            pose = match.motion.pose_odom_base if measured is None else measured.pose_odom_base
            self._add_heading(sensor, at_ns, pose)
        elif self._stamps.first is None:
            self._stamps.first = sensor
        self._odometry_mounting.add_pose(at_ns, match.motion.pose_odom_base)
        fault = self._odometry_mounting.fault or motion_fault
        return match._replace(state="degraded", reason=fault) if fault else match

    def _add_heading(self, sensor: str, at_ns: int, pose: SE2) -> None:
        """Add the heading by the configured mounting: a refined one follows late stamps in turns."""
        turned = pose @ self.lasers[sensor].mounting.applied
        self._stamps.add(sensor, at_ns, turned.theta_rad)

    def _contradicted(self, match: Match, other: str, few: Reason) -> Verdict:
        """Verdict on a scan that fits nowhere while another laser confirms the pose: its laser is at fault.

        A scan with few returns contradicts nothing: its laser is covered, or nothing is in range.
        """
        sensor = match.points.scan.sensor
        if few:
            words = f"{few} It is not mapped; {other} confirms the map"
            return Verdict("degraded", Reason("laser_covered", words))
        self._counters[f"scans_contradicting_{sensor}"] += 1
        reason = Reason(
            "laser_contradicts",
            f"{sensor} contradicts the map that {other} confirms ({match.reason}); its scan is not "
            "mapped. Is its mounting as configured, is its window clean?",
        )
        return Verdict("degraded", reason)

    def _confirmed_by_another(self, sensor: str, at_ns: int) -> str:
        """Another laser whose scans confirmed the pose recently; "" where there is none."""
        confirming = [
            name
            for name, laser in self.lasers.items()
            if name != sensor
            and laser.confirmed_ns is not None
            and at_ns - laser.confirmed_ns <= CONFIRMED_NS
        ]
        return min(confirming, default="")
