"""Time of each driver to decode the bytes of one scan, or of one sample, into a frame."""

import time
from typing import Any

import numpy as np

from drivers.sick_lms100.protocol import Dialect
from simulators.sick_setup import Lms100Setup
from tests.drivers import lms100, lux, mtig, utm30lx
from tests.drivers.virtual_time import Talk

SECONDS = 20.0  # of virtual time


def measure() -> list[tuple[str, float, str]]:
    conversations = {
        "541 beams, CoLa-A": lms100.talk(Lms100Setup(dialect=Dialect.ASCII)),
        "541 beams, CoLa-B": lms100.talk(Lms100Setup(dialect=Dialect.BINARY)),
        "1081 beams, SCIP MD": utm30lx.talk(),
        "1081 beams, SCIP ME": utm30lx.talk(intensity=True),
        "LUX scan of 4 layers": lux.talk(),
        "MTData2 sample": mtig.talk(),
        "MTData sample of an MTi-G": mtig.talk(mtig.legacy()),
    }
    return [(f"{what}, p50", _median_us(talk), "us") for what, talk in conversations.items()]


def _median_us(conversation: Talk) -> float:
    receive = conversation.session.receive_data
    took_us: list[float] = []

    def timed(data: bytes, arrived_ns: int) -> Any:
        began_ns = time.perf_counter_ns()
        frames = receive(data, arrived_ns)
        if frames:
            took_us.append((time.perf_counter_ns() - began_ns) / 1e3)
        return frames

    conversation.session.receive_data = timed  # type: ignore[method-assign]
    conversation.run(SECONDS)
    return float(np.median(took_us))
