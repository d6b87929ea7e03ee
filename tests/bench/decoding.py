"""What it costs the driver to turn a telegram of 541 beams into a scan, in both dialects."""

import time

import numpy as np

from drivers.sick_lms100.protocol import Dialect
from simulators.sick_lms100 import Lms100Setup
from tests.drivers.lms100 import talk

SECONDS = 20.0  # of virtual time, 50 scans each


def measure() -> list[tuple[str, float, str]]:
    rows = []
    for name, dialect in (("CoLa-A", Dialect.ASCII), ("CoLa-B", Dialect.BINARY)):
        conversation = talk(Lms100Setup(dialect=dialect))
        receive = conversation.session.receive_data
        took_us: list[float] = []

        def timed(data: bytes, arrived_ns: int, receive=receive, took_us=took_us):
            began_ns = time.perf_counter_ns()
            frames = receive(data, arrived_ns)
            if frames:
                took_us.append((time.perf_counter_ns() - began_ns) / 1e3)
            return frames

        conversation.session.receive_data = timed  # type: ignore[method-assign]
        conversation.run(SECONDS)
        rows.append((f"541 beams, {name}, p50", float(np.median(took_us)), "us"))
    return rows
