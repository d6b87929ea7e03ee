"""One short drive of the demo, recorded for the programs that read recordings and trajectories."""

import json
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from service.demo import interpolate
from service.geometry.se2 import SE2
from service.recording.mcap_reader import Recording
from tests.interop.programs import InteropError, run

SECONDS = 15
CORRIDOR = str(Path(sys.executable).parent / "corridor")


@dataclass(frozen=True, slots=True)
class Session:
    """What the demo left behind."""

    mcap: Path
    truth: Path  # stamp_ns x_m y_m theta_rad, host's monotonic clock, frame of the start
    utc_offset_ns: int  # Unix time minus monotonic time

    def true_poses(self, stamps_ns: list[int]) -> list[SE2]:
        """Where the vehicle really was at these Unix times, in the frame of its start."""
        monotonic_ns = np.array(stamps_ns, dtype=np.int64) - self.utc_offset_ns
        return interpolate(np.loadtxt(self.truth, ndmin=2), monotonic_ns)


def session(folder: Path) -> Session:
    """Record it at the first call, find it again at the next. Raises InteropError."""
    out = folder / "session"
    if not (out / "done").exists():
        facts = run([CORRIDOR, "demo", "--json", "--seconds", str(SECONDS), "--out", str(out)])
        if json.loads(facts)["scans"] < 40 * SECONDS:
            raise InteropError(f"the demo mapped {json.loads(facts)['scans']} scans in {SECONDS} s")
        (out / "done").touch()
    (mcap,) = out.glob("*.mcap")
    offset_ns = int(Recording([mcap]).metadata["clock"]["utc_offset_ns"])
    return Session(mcap, out / "truth.txt", offset_ns)
