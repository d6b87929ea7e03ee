"""What a service says of itself: in the status line of a terminal, and at the end of its run."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from drivers.counted import counted
from service.encoding import decode_pose
from service.geometry.se2 import SE2
from service.mapstore.tiles import TileStore
from service.runtime.health import HealthReport
from service.runtime.mapper_messages import Mapped
from service.runtime.metrics import LatencyHistogram, Percentiles


@dataclass(frozen=True, slots=True)
class Summary:
    """Results of a run of the service."""

    seconds: float  # from READY to the end
    scans: int
    scans_dropped: int
    states: dict[str, int]  # scans by state
    latency_ms: Percentiles  # from the last byte of a scan read to its pose on the network
    scan_cpu_ms: Percentiles  # processor time of a scan in the mapper
    rates_hz: dict[str, float]  # by sensor
    cpu_percent: float  # of one core: this process and the mapper's
    written: Mapping[str, list[Path]]  # what each sink has completed on disk, by name of the sink
    utc_offset_ns: int  # Unix time minus host monotonic time, for the run
    failure: str = ""  # what failed, and what map or recording lacks; "" where neither

    @property
    def sessions(self) -> list[Path]:
        """Recorded sessions, oldest first."""
        return list(self.written.get("recording", []))

    @property
    def map_folder(self) -> Path | None:
        """Folder of the newest map; None where nothing was mapped."""
        return next(iter(self.written.get("map", [])), None)

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "seconds": self.seconds,
            "scans": self.scans,
            "scans_dropped": self.scans_dropped,
            "state": self.states,
            "latency_ms": self.latency_ms.as_dict(),
            "scan_cpu_ms": self.scan_cpu_ms.as_dict(),
            "rates_hz": self.rates_hz,
            "cpu_percent": self.cpu_percent,
            "sessions": [str(path) for path in self.sessions],
            "map": str(self.map_folder) if self.map_folder else None,
            "failure": self.failure or None,
        }


@dataclass(frozen=True, slots=True)
class RunningStatus:
    """State at the newest health report, the pose at the newest scan."""

    state: str  # of the mapping: ok, degraded, lost, waiting, stale, paused, overloaded
    reason: str  # in words; that of health
    pose_map_base: SE2 | None  # None before the first scan is mapped
    rates_hz: Mapping[str, float]  # frames a second, by sensor
    latency_ms: Percentiles  # from the last byte of a scan read to its pose on the network
    map_m: tuple[float, float]  # width and height that the tiles of the map cover
    tiles: int

    def __str__(self) -> str:
        parts = [self.state]
        if self.pose_map_base is not None:
            pose = self.pose_map_base
            parts.append(f"x {pose.x_m:.2f} y {pose.y_m:.2f} m, {math.degrees(pose.theta_rad):.0f} deg")
        parts.append(" ".join(f"{name} {hz:.0f}" for name, hz in self.rates_hz.items()) + " Hz")
        if self.latency_ms.max:
            parts.append(f"latency {self.latency_ms.p50:.1f} ms, p99 {self.latency_ms.p99:.0f}")
        if self.tiles:
            parts.append(f"map {self.map_m[0]:.0f} x {self.map_m[1]:.0f} m, {counted(self.tiles, 'tile')}")
        if self.reason != self.state:
            parts.append(self.reason)
        return " | ".join(parts)


def running_status(
    report: HealthReport, last: Mapped | None, latency: LatencyHistogram, tiles: TileStore
) -> RunningStatus:
    """Put together from the parts of a service. Any thread."""
    state, reason = report.mapping_state
    pose = decode_pose(last.messages[0].payload).pose if last is not None and last.messages else None
    return RunningStatus(
        state, reason, pose, report.rates_hz, latency.percentiles(), tiles.extent_m, tiles.finest_count
    )
