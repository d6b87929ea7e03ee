"""Why scans were degraded or lost, for the summary of a replay."""

from collections.abc import Iterator, Mapping
from typing import Any

from drivers.counted import counted
from service.outputs import MapperOutput
from service.timing.words import kind_of

STATES = ("degraded", "lost")
MAX_KINDS = 5  # of reasons, of each state


class StateReasons:
    """Counts the reasons of outputs; those that differ in their numbers alone are of one kind."""

    def __init__(self) -> None:
        self._begin_ns: int | None = None
        self._kinds: dict[tuple[str, str], dict[str, Any]] = {}  # by state and reason without its numbers

    def add(self, output: MapperOutput) -> None:
        """The next one, whatever its state."""
        if self._begin_ns is None:
            self._begin_ns = output.stamp_ns
        if output.state not in STATES:
            return
        kind = output.state, kind_of(output.reason)
        if kind not in self._kinds:
            first_s = round((output.stamp_ns - self._begin_ns) / 1e9, 3)
            self._kinds[kind] = {
                "id": output.reason.id,
                "reason": str(output.reason),
                "scans": 0,
                "first_s": first_s,
            }
        self._kinds[kind]["scans"] += 1

    def as_dict(self) -> dict[str, list[dict[str, Any]]]:
        """State -> its most frequent kinds: id of the reason, the first reason, how many scans it has, and
        when it came first, in s after the first scan.
        """
        kinds = sorted(self._kinds.items(), key=lambda kind: -kind[1]["scans"])
        return {state: [facts for (of, _), facts in kinds if of == state][:MAX_KINDS] for state in STATES}


def doubts(summary: Mapping[str, Any]) -> Iterator[str]:
    """A line for each state but ok: how many of the scans are in it, and mostly why."""
    for state, kinds in summary["state_reasons"].items():
        for main in kinds[:1]:
            count = summary["state"][state]
            yield (
                f"{count} of {counted(summary['scans'], 'scan')} {'was' if count == 1 else 'were'} {state}; "
                f"{main['scans']} of them, from {main['first_s']:.1f} s on: {main['reason']}"
            )
