"""By how much the stamps of a device are late, as its config may say it."""

from typing import Annotated

from pydantic import Field

# A scan is mapped that began 300 ms before the newest pose at most: the latency and a sweep of 80 ms.
LEAST_LATENCY_MS, MOST_LATENCY_MS = -50.0, 200.0
LatencyMs = Annotated[float, Field(ge=LEAST_LATENCY_MS, le=MOST_LATENCY_MS)]  # positive makes stamps earlier
