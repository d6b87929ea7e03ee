"""Health of the service: a diagnostic status for each sensor and each part behind them."""

import math
from collections import Counter, deque
from collections.abc import Callable, Mapping
from typing import Literal

from drivers.counted import counted
from drivers.link import LinkHealth
from service.encoding import ERROR, LEVEL_OF_STATE, OK, STALE, WARNING, Message, Status, encode_diagnostics
from service.geometry.geo_reference import GeoReference
from service.mapper.profiles import MappingConfig
from service.outputs import HealthReasonId, ReasonId
from service.publishing.commands import CommandDispatcher
from service.runtime.intake import Intake
from service.runtime.mapper_link import MapperLink
from service.runtime.mapping_outputs import MappingOutputs
from service.runtime.metrics import LatencyHistogram, RateMeter
from service.sinks.fan_out import Sinks

STALE_AFTER_NS = 1_000_000_000
LATE_NS = 500_000_000  # from a measurement to its arrival: beyond the delay of any device and link
POSE_STALE_NS = 500_000_000  # the slowest laser sends each 80 ms
FIRST_POSE_NS = 5_000_000_000  # so long devices may take to log in
RESTARTS_WITHIN_NS = 60_000_000_000
MAX_RESTARTS = 1  # of the mapper in that time: one is what the stand-by is for, more are a fault that stays

MAX_BEHIND_S = 30.0  # of the back end: a batch takes a second, one at a place that is searched for some
LINE_NS = 10_000_000_000  # at least, from one line about a passing state to the next
_PASSING = {"ok", "degraded", "overloaded"}  # states that may alternate

_CHECK = "if it stays so, check its power, cable and address, or run corridor doctor"
_RESTART = "if it stays so, start the service again; its log says more"

_LEVEL_OF_LINK = {"streaming": OK, "starting": WARNING, "connecting": WARNING, "down": ERROR}
RECENT_NS = 10_000_000_000  # counts of this time are reported

# By counter, the worst first: level and words.
FAULTS = {
    "fixes_frozen": (WARNING, "the receiver repeats one position while the vehicle moves; is it stuck?"),
    "fixes_impossible": (WARNING, "fixes with impossible coordinates; is the receiver set up correctly?"),
    "fixes_contradicting": (
        WARNING,
        "fixes contradict the driven path and are not used: multipath, a jump, or a wrong lever arm",
    ),
    "fixes_of_another_receiver": (WARNING, "fixes of a second receiver; only the first receiver is used"),
    "fixes_without_covariance": (
        WARNING,
        "fixes without a covariance are not used; configure the receiver to send its accuracy",
    ),
    "fixes_out_of_order": (WARNING, "fixes whose stamps do not rise"),
    "fixes_without_scans": (WARNING, "fixes from moments without scans"),
    "fixes_too_poor": (OK, "fixes are worse than 10 m; is there open sky?"),
    "fixes_without_position": (OK, "the receiver has no position; indoors this is normal"),
}


class SensorHealth:
    """One sensor's status, second by second."""

    def __init__(self, link: LinkHealth) -> None:
        self._link = link
        self._frames = RateMeter()
        self._bytes = RateMeter()
        self._first: tuple[int, int] | None = None  # frames and time of the newest, at the first status

    @property
    def rate_hz(self) -> float:
        """Frames a second between the last two statuses."""
        return self._frames.rate_hz

    @property
    def mean_rate_hz(self) -> float:
        """Frames a second from the first status on to the newest frame; gaps count."""
        if self._first is None or self._link.last_frame_ns <= self._first[1]:
            return 0.0
        return (self._link.frames - self._first[0]) * 1e9 / (self._link.last_frame_ns - self._first[1])

    def status(self, dropped: int, unusable: int, now_ns: int) -> Status:
        """dropped: scans that were too old to be mapped; now_ns: host monotonic."""
        link = self._link
        if self._first is None and link.frames > 0:
            self._first = (link.frames, link.last_frame_ns)
        rate_hz = self._frames.read(link.frames, now_ns)
        level, words = _LEVEL_OF_LINK[link.state], link.status or link.state
        reason: HealthReasonId | Literal[""] = ""
        silent_s = max(now_ns - link.last_frame_ns, 0) / 1e9
        if link.state == "down":
            reason = "link_down"
            words = f"{link.name}: {link.last_error} (expected frames); {_CHECK}"
        elif link.state != "streaming":
            reason = "no_frame"
            words = (
                f"{link.name}: {words}, no frame yet (expected within {_seconds(FIRST_POSE_NS)}); {_CHECK}"
            )
        elif now_ns - link.last_frame_ns > STALE_AFTER_NS:
            level, reason = STALE, "frames_stopped"
            words = (
                f"{link.name}: no frame for {silent_s:.1f} s (expected one each "
                f"{_seconds(STALE_AFTER_NS)} at least); {_CHECK}"
            )
        elif link.delay_ns > LATE_NS:
            level, reason = WARNING, "frames_late"
            words = (
                f"{link.name}: frames arrive {link.delay_ns / 1e9:.1f} s after they were measured (expected "
                f"at most {_seconds(LATE_NS)}), too old to be mapped. Is its link, or this computer, slow?"
            )
        offset_ns = link.clock_offset_ns
        values = {
            "state": link.state,
            "status": link.status,
            "reason_id": reason,
            "rate_hz": f"{rate_hz:.1f}",
            "kilobytes_per_s": f"{self._bytes.read(link.bytes_read, now_ns) / 1e3:.1f}",
            "frames": str(link.frames),
            "dropped": str(dropped),
            "unusable": str(unusable),
            "age_s": f"{silent_s:.2f}" if link.last_frame_ns else "",
            "delay_ms": f"{link.delay_ns / 1e6:.1f}" if link.last_frame_ns else "",
            "connects": str(link.connects),
            "device_clock_s": "" if offset_ns is None else f"{(now_ns - offset_ns) / 1e9:.0f}",
            "clock_offset_ms": "" if offset_ns is None else f"{offset_ns / 1e6:.3f}",
            "clock_sigma_ms": "" if link.clock_sigma_ns is None else f"{link.clock_sigma_ns / 1e6:.3f}",
            "last_error": link.last_error,
        }
        values.update({f"count.{key}": str(count) for key, count in sorted(link.counters.items())})
        values.update({f"identity.{key}": text for key, text in sorted(link.identity.items())})
        return Status(f"sensor/{link.name}", level, words, values)


class HealthReport:
    """All statuses, made again by `update`."""

    def __init__(
        self,
        links: Mapping[str, LinkHealth],
        intake: Intake,
        link: MapperLink,
        outputs: MappingOutputs,
        sinks: Sinks,
        latency: LatencyHistogram,
        dispatcher: CommandDispatcher,
        mapping: Callable[[], MappingConfig],
    ) -> None:
        """mapping: the section of the config as it is now."""
        self._links = links
        self._sensors = {name: SensorHealth(link) for name, link in links.items()}
        self._intake = intake
        self._link = link
        self._outputs = outputs
        self._sinks = sinks
        self._latency = latency
        self._dispatcher = dispatcher
        self._mapping_config = mapping
        self._scan_rate = RateMeter()
        self._states = dict.fromkeys(links, "connecting")
        self._mapping_state_reported, self._mapping_reported_ns = "waiting", 0
        self._gnss_health = GnssHealth()
        self._restarted_ns: deque[int] = deque()  # when the mapper was, host monotonic
        self._restarts = 0  # in all, at the last update
        self.statuses: list[Status] = []
        self.clock_step_ns = self._now_ns = self._began_ns = 0

    @property
    def scans_dropped(self) -> int:
        """Scans that were received completely and not mapped, for whatever reason."""
        counters = self._outputs.counters
        late = sum(count for name, count in counters.items() if name.startswith("scans_dropped"))
        return sum(dict(self._outputs.passed_over).values()) + late + self._outputs.unusable_scans

    @property
    def mean_rates_hz(self) -> dict[str, float]:
        return {name: round(sensor.mean_rate_hz, 2) for name, sensor in self._sensors.items()}

    @property
    def rates_hz(self) -> dict[str, float]:
        """Frames a second by the last two updates."""
        return {name: sensor.rate_hz for name, sensor in self._sensors.items()}

    @property
    def mapping_state(self) -> tuple[str, str]:
        """State at the last update and why: ok, degraded, lost, stale, overloaded (and not lost), paused;
        waiting before the first scan is mapped.
        """
        facts = next((status for status in self.statuses if status.name == "mapping"), None)
        return ("waiting", "") if facts is None else (facts.values.get("state", "waiting"), facts.message)

    @property
    def line(self) -> str:
        """One line for `systemctl status`."""
        state, _ = self.mapping_state
        streaming = sum(link.state == "streaming" for link in self._links.values())
        words = [
            "waiting for a scan" if state == "waiting" else f"mapping {state}",
            f"{streaming}/{len(self._links)} sensors",
            f"{self._scan_rate.rate_hz:.1f} scans/s",
            *self._sinks.status_words(),
        ]
        return ", ".join(words)

    def update(self, now_ns: int, clock_step_ns: int) -> None:
        """Make all statuses.

        now_ns          host monotonic: as of when frames and poses are fresh
        clock_step_ns   how far the wall clock has stepped
        """
        self.clock_step_ns, self._now_ns = clock_step_ns, now_ns
        self._began_ns = self._began_ns or now_ns
        self._scan_rate.read(sum(dict(self._outputs.states).values()), now_ns)
        self._note_restarts(now_ns)
        dropped, unusable = self._outputs.passed_over, self._outputs.unusable
        sensors = [s.status(dropped[name], unusable[name], now_ns) for name, s in self._sensors.items()]
        self.statuses = [
            *sensors,
            self._mapping(),
            self._timing(),
            *self._gnss(now_ns),
            *self._sinks.health(),
            self._clock(),
            self._commands(),
        ]

    def message(self, unix_ns: int) -> Message:
        return encode_diagnostics("diagnostics", self.statuses, unix_ns, unix_ns)

    def take_state_changes(self) -> list[tuple[str, str]]:
        """Sensors whose link is in another state than at the last call, with that state."""
        states = {name: link.state for name, link in self._links.items()}
        changes = [(name, state) for name, state in states.items() if state != self._states[name]]
        self._states = states
        return changes

    def take_mapping_change(self) -> tuple[str, str] | None:
        """`mapping_state` where the state is another one than at the last call; None where it is the same.

        Between ok, degraded and overloaded it changes at most each LINE_NS, to what it is then.
        """
        state, reason = self.mapping_state
        if state == self._mapping_state_reported:
            return None
        is_passing = {state, self._mapping_state_reported} <= _PASSING
        if is_passing and self._now_ns - self._mapping_reported_ns < LINE_NS:
            return None
        self._mapping_state_reported, self._mapping_reported_ns = state, self._now_ns
        return state, reason

    def _mapping_values(self) -> dict[str, str]:
        """Values that do not depend on the newest scan."""
        outputs, config = self._outputs, self._mapping_config()
        values = {name: str(count) for name, count in sorted(outputs.counters.items())}
        values |= {
            "profile": config.profile,
            "configured_mode": config.mode,
            "mode": "localization" if outputs.is_localizing else "mapping",
            "lasers": " ".join(outputs.lasers),
            "scan_rate_hz": f"{self._scan_rate.rate_hz:.1f}",
            "scans_dropped": str(self.scans_dropped),
            "queue_length": str(self._link.waiting),
            "graph_behind_s": f"{outputs.graph_behind_s:.1f}",
            "restarts": str(outputs.restarts),
            "restart_reason": outputs.restart_reason,
        }
        values |= {f"scans_{state}": str(count) for state, count in _snapshot(outputs.states)}
        for name, histogram in (("latency_ms", self._latency), ("scan_cpu_ms", outputs.scan_cpu)):
            percentiles = histogram.percentiles().as_dict()
            values |= {f"{name}_{percentile}": f"{ms:.3f}" for percentile, ms in percentiles.items()}
        return values

    def _mapping(self) -> Status:
        outputs, last, values = self._outputs, self._outputs.last, self._mapping_values()
        if self._intake.paused:
            values |= {"state": "paused", "reason_id": "paused"}
            words = "paused by a command; scans are recorded, not mapped. Resume maps again"
            return Status("mapping", WARNING, words, values)
        if outputs.graph_fault:
            values["graph_fault"] = outputs.graph_fault
        if last is None:
            return self._no_scan_mapped(values | {"reason_id": "no_scan"})
        age_s = max(self._now_ns - outputs.last_ns, 0) / 1e9
        reason: ReasonId | HealthReasonId = last.reason.id
        values |= {"state": last.state, "reason_id": reason}
        values |= {"inlier_ratio": f"{last.inlier_ratio:.3f}", "age_s": f"{age_s:.2f}"}
        if self._now_ns - outputs.last_ns > POSE_STALE_NS:
            values |= {"state": "stale", "reason_id": "no_pose"}
            expected = f"expected one each {_seconds(POSE_STALE_NS)} at least"
            words = f"no pose for {age_s:.1f} s ({expected}): {self._why_unmapped()}"
            return Status("mapping", ERROR, words, values)
        level, words = LEVEL_OF_STATE[last.state], last.reason or last.state
        if overload := outputs.overload():
            values["state"] = "lost" if last.state == "lost" else "overloaded"
            words = overload if last.state == "ok" else f"{words}; {overload}"
            values["reason_id"] = reason or "overloaded"
            return Status("mapping", max(level, WARNING), words, values)
        if level == OK and outputs.graph_fault:
            level, reason = WARNING, "no_loops"
            words = (
                f"no loops are closed (expected where a place is seen again): {outputs.graph_fault}; the map "
                "may drift. Start the service again when the vehicle can wait"
            )
        if level == OK and outputs.graph_behind_s > MAX_BEHIND_S:
            level, reason = WARNING, "graph_behind"
            words = (
                f"loops are closed {outputs.graph_behind_s:.0f} s late (expected within {MAX_BEHIND_S:g} s); "
                "the map is corrected later. Does another program take the processor?"
            )
        if level == OK and len(self._restarted_ns) > MAX_RESTARTS:
            level, reason = WARNING, "mapper_restarted"
            words = (
                f"the mapper was restarted {len(self._restarted_ns)} times in the last minute (expected "
                f"at most {MAX_RESTARTS}); at the last time its process {outputs.restart_reason}; {_RESTART}"
            )
        return Status("mapping", level, words, values | {"reason_id": reason})

    def _no_scan_mapped(self, values: dict[str, str]) -> Status:
        lasers = " or ".join(self._outputs.lasers)
        words = (
            f"no scan of {lasers} mapped yet (expected within {_seconds(FIRST_POSE_NS)})"
            if lasers
            else "no laser is mapped (expected one at least); configure one, or remove its map: false"
        )
        since_ns = max(self._began_ns, self._outputs.last_ns)  # the latter where the map was reset
        level = WARNING if self._now_ns - since_ns <= FIRST_POSE_NS else ERROR
        why = self._why_unmapped() if lasers else ""
        return Status("mapping", level, ": ".join(filter(None, (words, why))), values)

    def _why_unmapped(self) -> str:
        """Why no pose comes, and what to do."""
        rates = [
            f"{name} sends {self._sensors[name].rate_hz:.0f} scans/s"
            for name in self._outputs.lasers
            if self._links[name].frames and self._now_ns - self._links[name].last_frame_ns <= POSE_STALE_NS
        ]
        if not rates:
            lasers = self._outputs.lasers
            rows = " or ".join(f"sensor/{name}" for name in lasers)
            return f"no scan of {' or '.join(lasers)} comes; the status {rows} says what to check"
        silent_s = self._link.silent_s
        if not self._link.pid:
            mapper = "the mapper's process has ended and no stand-by has taken over yet"
        elif silent_s > POSE_STALE_NS / 1e9:
            items = self._link.waiting
            mapper = f"the mapper has not answered for {silent_s:.1f} s while {items} items wait for it"
        else:
            mapper = self._outputs.overload() or "the mapper maps none of them"
        return f"{' and '.join(rates)}, but {mapper}; {_RESTART}"

    def _note_restarts(self, now_ns: int) -> None:
        new, self._restarts = self._outputs.restarts - self._restarts, self._outputs.restarts
        self._restarted_ns.extend([now_ns] * new)
        while self._restarted_ns and now_ns - self._restarted_ns[0] > RESTARTS_WITHIN_NS:
            self._restarted_ns.popleft()

    def _gnss(self, now_ns: int) -> list[Status]:
        """Empty where there are no fixes."""
        status = self._gnss_health.status(self._outputs.counters, self._outputs.geo_reference, now_ns)
        return [] if status is None else [status]

    def _timing(self) -> Status:
        """Stamps and time fields of the frames that are mapped."""
        warnings = self._outputs.time_warnings
        values = {"warnings": str(len(warnings))}
        if not warnings:
            return Status("timing", OK, "ok", values)
        return Status("timing", WARNING, "; ".join(warnings), values)

    def _clock(self) -> Status:
        step_s = self.clock_step_ns / 1e9
        values = {"step_s": f"{step_s:.3f}"}
        if self.clock_step_ns == 0:
            return Status("clock", OK, "steady", values)
        words = (
            f"the wall clock stepped by {step_s:+.3f} s since start (expected none); stamps keep to the time "
            "of the start. Start the service again to take the new one"
        )
        return Status("clock", WARNING, words, values | {"reason_id": "clock_stepped"})

    def _commands(self) -> Status:
        """Counts of marks, pauses ... since the start."""
        counts = self._dispatcher.counts()
        return Status("commands", OK, "ok", {name: str(count) for name, count in sorted(counts.items())})


def _seconds(ns: int) -> str:
    return f"{ns / 1e9:g} s"


def _snapshot(counters: Counter[str]) -> list[tuple[str, int]]:
    """Counts by name, copied in one step: their owner, another thread, continues to count."""
    return sorted(dict(counters).items())


class GnssHealth:
    """Reports the counts of the last seconds."""

    def __init__(self) -> None:
        self._counted: dict[str, int] = {}
        self._rose_ns: dict[str, int] = {}

    def status(
        self, counters: Mapping[str, int], reference: GeoReference | None, now_ns: int
    ) -> Status | None:
        """None where no fix has come, or no graph uses fixes. now_ns: host monotonic."""
        fixes = {name: count for name, count in counters.items() if name.startswith("fixes_")}
        if not fixes.keys() - {"fixes_passed_over"}:
            return None
        self._rose_ns = {name: ns for name, ns in self._rose_ns.items() if name in fixes}  # of this map
        for name, count in fixes.items():
            if count > self._counted.get(name, 0):
                self._rose_ns[name] = now_ns
        self._counted = fixes
        values = {name: str(count) for name, count in sorted(fixes.items())}
        values["referenced"] = str(reference is not None).lower()
        level, words = OK, "not referenced yet: fixes must agree with 100 to 300 m of the driven path"
        if reference is not None:
            yaw_sigma_deg = math.degrees(reference.yaw_sigma_rad)
            values |= {
                "position_sigma_m": f"{reference.position_sigma_m:.2f}",
                "yaw_sigma_deg": f"{yaw_sigma_deg:.2f}",
                "map_yaw_enu_deg": f"{math.degrees(reference.pose_enu_map.theta_rad):.2f}",
                "origin": f"{reference.origin.latitude_deg:.7f} {reference.origin.longitude_deg:.7f}",
            }
            words = (
                f"referenced to {reference.position_sigma_m:.1f} m and {yaw_sigma_deg:.1f} deg "
                f"by {counted(reference.fixes, 'fix', 'fixes')}"
            )
        for name, (fault_level, fault) in FAULTS.items():
            if name in self._rose_ns and now_ns - self._rose_ns[name] <= RECENT_NS:
                return Status("gnss", fault_level, f"{fault} ({fixes[name]} so far); {words}", values)
        return Status("gnss", level, words, values)
