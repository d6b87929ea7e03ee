"""What the service knows of itself, as diagnostic statuses: one a sensor, one for each part behind them."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

from drivers.link import LinkHealth
from service.encoding import Status
from service.outputs import MapperOutput
from service.runtime.metrics import LatencyHistogram, RateMeter

OK, WARNING, ERROR, STALE = 0, 1, 2, 3  # levels of diagnostic_msgs/DiagnosticStatus
STALE_AFTER_NS = 1_000_000_000

_LEVEL_OF_STATE = {"streaming": OK, "starting": WARNING, "connecting": WARNING, "down": ERROR}
_LEVEL_OF_MAPPING = {"ok": OK, "degraded": WARNING, "lost": ERROR}


class SensorHealth:
    """One sensor's status, second by second."""

    def __init__(self, link: LinkHealth) -> None:
        self._link = link
        self._frames = RateMeter()
        self._bytes = RateMeter()

    @property
    def streaming(self) -> bool:
        return self._link.state == "streaming"

    def status(self, dropped: int, unusable: int, now_ns: int) -> Status:
        """dropped: scans that had to make room in the queue; now_ns: host monotonic."""
        link = self._link
        rate_hz = self._frames.read(link.frames, now_ns)
        bytes_hz = self._bytes.read(link.bytes_read, now_ns)
        level, words = _LEVEL_OF_STATE[link.state], link.status or link.state
        silent_s = (now_ns - link.last_frame_ns) / 1e9
        if link.state == "down":
            words = link.last_error
        elif link.state == "streaming" and now_ns - link.last_frame_ns > STALE_AFTER_NS:
            level, words = STALE, f"no frame for {silent_s:.1f} s"
        values = {
            "state": link.state,
            "status": link.status,
            "rate_hz": f"{rate_hz:.1f}",
            "kilobytes_per_s": f"{bytes_hz / 1e3:.1f}",
            "frames": str(link.frames),
            "dropped": str(dropped),
            "unusable": str(unusable),
            "age_s": f"{silent_s:.2f}" if link.last_frame_ns else "",
            "connects": str(link.connects),
            "clock_offset_ms": "" if link.clock_offset_ns is None else f"{link.clock_offset_ns / 1e6:.3f}",
            "last_error": link.last_error,
        }
        values.update({f"count.{key}": str(count) for key, count in sorted(link.counters.items())})
        values.update({f"identity.{key}": text for key, text in sorted(link.identity.items())})
        return Status(f"sensor/{link.name}", level, words, values)


@dataclass(frozen=True, slots=True)
class MappingCounts:
    """What the mapping thread has done so far."""

    scans: int
    scans_dropped: int  # in the queue and as late
    samples_late: int
    states: Mapping[str, int]
    queue_length: int
    queue_deepest: int


def mapping_status(output: MapperOutput | None, counts: MappingCounts, latency: LatencyHistogram) -> Status:
    """How the mapping goes; latency is from a scan's last byte to its pose on Zenoh."""
    values = {
        "scans": str(counts.scans),
        "scans_dropped": str(counts.scans_dropped),
        "samples_late": str(counts.samples_late),
        "queue_length": str(counts.queue_length),
        "queue_deepest": str(counts.queue_deepest),
    }
    values.update({f"scans_{state}": str(count) for state, count in sorted(counts.states.items())})
    values.update({f"latency_ms_{name}": f"{ms:.3f}" for name, ms in latency.percentiles().as_dict().items()})
    if output is None:
        return Status("mapping", WARNING, "no scan mapped yet", values)
    values["match_share"] = f"{output.match_share:.3f}"
    values["state"] = output.state
    level = _LEVEL_OF_MAPPING[output.state]
    return Status("mapping", level, output.reason or output.state, values)


def clock_status(step_ns: int) -> Status:
    """Whether the wall clock has left the one the stamps are made with."""
    values = {"step_s": f"{step_ns / 1e9:.3f}"}
    if step_ns == 0:
        return Status("clock", OK, "steady", values)
    words = f"the wall clock stepped by {step_ns / 1e9:+.3f} s since start; stamps keep to the time of start"
    return Status("clock", WARNING, words, values)


def part_status(name: str, trouble: str, counts: Mapping[str, int | str]) -> Status:
    """A part that either works or says what troubles it."""
    values = {key: str(value) for key, value in counts.items()}
    return Status(name, ERROR if trouble else OK, trouble or "ok", values)


def status_line(statuses: list[Status], streaming: int, sensors: int, rate_hz: float, recording: str) -> str:
    """One line for `systemctl status`."""
    words = {status.name: status for status in statuses}["mapping"].message
    recorded = f"recording {recording}" if recording else "not recording"
    return f"mapping {words}, {streaming}/{sensors} sensors, {rate_hz:.1f} scans/s, {recorded}"


def dropped_scans(queue_drops: Counter[str], counters: Counter[str]) -> int:
    """Scans that came in and were not mapped, for whatever reason."""
    late = sum(count for name, count in counters.items() if name.startswith("scans_dropped"))
    return sum(queue_drops.values()) + late
