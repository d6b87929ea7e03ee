"""Results of a run of the service."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from service.runtime.metrics import Percentiles


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
