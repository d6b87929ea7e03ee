"""`corridor demo` as a user runs it, and what its fake devices reported of themselves meanwhile."""

import json
import re
import subprocess
import sys
import threading
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from service.encoding import decode_frame
from service.recording.mcap_reader import Recording
from simulators.device import TURNS_SKIPPED
from simulators.wire import DROPPED
from tests.in_background import in_background

HERE = Path(sys.executable).parent / "corridor"  # of the tree that is tested
ENDS_WITHIN_S = 100.0  # beyond the time asked for and a tenth of it, in which the recording is read
LOOK_S = 10.0
IN_TIME_S, STALL_S = 0.1, 0.5
LEFT_OUT = re.compile(rf"^(\w+): (\d+) more (?:{TURNS_SKIPPED}|{DROPPED})", re.MULTILINE)


@dataclass(frozen=True)
class DemoRun:
    """left_out: measurements that a fake device could not send, by sensor. A machine that is busy with other
    things gives it no processor for a while, or none to the service, until all buffers between them are full.
    late_s: from the moment of measurement to the pose; all but the worst of a hundred.
    """

    seconds: int
    summary: dict[str, Any]
    left_out: Counter[str]
    late_s: float

    @property
    def was_in_time(self) -> bool:
        """Whether stamps could be correct to some centimetres of path. A clock that is new or has jumped is
        learnt from arrivals, so that its stamps are late by the delays of the machine.
        """
        longest_s = self.summary["latency_ms"]["max"] / 1e3
        return not self.left_out and self.late_s < IN_TIME_S and longest_s < STALL_S


def run_demo(
    seconds: int,
    folder: Path,
    look: Callable[[int], None] = lambda process: None,
    program: Path = HERE,
    environment: Mapping[str, str] | None = None,
) -> DemoRun:
    """`look` is called with the service's process id, each LOOK_S."""
    command = [str(program), "demo", "--json"]
    command += ["--seconds", str(seconds), "--out", str(folder)]

    def watch(ended: threading.Event) -> None:
        while not ended.wait(LOOK_S):
            look(process.pid)

    with subprocess.Popen(
        command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        try:
            with in_background(watch):
                output, log = process.communicate(timeout=1.1 * seconds + ENDS_WITHIN_S)
        finally:
            process.kill()
    assert process.returncode == 0, log
    left_out: Counter[str] = Counter()
    for name, count in LEFT_OUT.findall(log):
        left_out[name] += int(count)
    summary = json.loads(output)
    late_s = _reading_takes_s(Path(summary["session"])) + summary["latency_ms"]["p99"] / 1e3
    return DemoRun(seconds, summary, left_out, late_s)


def _reading_takes_s(session: Path) -> float:
    """From the moment of measurement until it is read, for samples, which no fault meets."""
    samples = [
        decode_frame(m.type, m.payload, "imu", m.log_ns) for m in Recording([session]).messages(["/imu/imu"])
    ]
    return float(np.percentile([s.arrived_ns - s.stamp_ns for s in samples if s is not None], 99)) / 1e9
