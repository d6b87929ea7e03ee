"""Latency of a device's stamps in its config."""

from typing import Annotated

from pydantic import Field

# A scan is mapped that began 300 ms before the newest pose at most: the latency and a sweep of 80 ms.
MIN_LATENCY_MS, MAX_LATENCY_MS = -50.0, 200.0
LatencyMs = Annotated[float, Field(ge=MIN_LATENCY_MS, le=MAX_LATENCY_MS)]  # positive makes stamps earlier
