"""How regularly frames came of each sensor of a recording: rates and gaps, by their stamps."""

from array import array
from collections import defaultdict
from typing import Any

import numpy as np

from drivers.frames import Frame
from service.timing.timing import KINDS

GAP_PERIODS = 3.0  # of the usual one: a longer interval is a gap
MAX_GAPS = 50  # that are listed of each, the longest


class SensorRates:
    """Takes the frames of a recording, in any order."""

    def __init__(self) -> None:
        self._stamps_ns: defaultdict[str, array[int]] = defaultdict(lambda: array("q"))

    def add(self, frame: Frame) -> None:
        self._stamps_ns[f"{frame.sensor}/{KINDS[type(frame)]}"].append(frame.stamp_ns)

    def as_dict(self, begin_ns: int) -> dict[str, dict[str, Any]]:
        """ "front/scan" -> its "frames", "rate_hz" (by the median period; None of a single stamp), "gaps"
        (how many intervals have more than GAP_PERIODS of these) and "longest_gaps", in the order of time:
        [begin in s since begin_ns, length in s] each.
        """
        return {name: _gaps(np.array(stamps), begin_ns) for name, stamps in sorted(self._stamps_ns.items())}


def _gaps(stamps_ns: np.ndarray, begin_ns: int) -> dict[str, Any]:
    at_ns = np.unique(stamps_ns)
    facts: dict[str, Any] = {"frames": len(stamps_ns), "rate_hz": None, "gaps": 0, "longest_gaps": []}
    if len(at_ns) < 2:
        return facts
    interval_ns = np.diff(at_ns)
    period_ns = float(np.median(interval_ns))
    gaps = np.flatnonzero(interval_ns > GAP_PERIODS * period_ns)
    longest = np.sort(gaps[np.argsort(-interval_ns[gaps], kind="stable")][:MAX_GAPS])
    return facts | {
        "rate_hz": round(1e9 / period_ns, 3),
        "gaps": len(gaps),
        "longest_gaps": [
            [round(int(at_ns[k] - begin_ns) / 1e9, 3), round(int(interval_ns[k]) / 1e9, 3)]
            for k in longest.tolist()
        ],
    }
