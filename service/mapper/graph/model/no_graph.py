"""Graph of the methods without one: map and odom are one frame."""

from collections.abc import Mapping
from typing import Any

from drivers.frames import GnssFix
from service.geometry.se2 import SE2
from service.mapper.components import FinishedGraph, GraphRequestError, MappedScan


class NoGraph:
    waiting = 0
    ready = False
    fault = ""
    finds_segments = False

    def add(self, scan: MappedScan) -> SE2:
        return SE2()

    def add_fix(self, fix: GnssFix) -> str:
        return "fixes_passed_over"

    def apply_result(self) -> None:
        return None

    def request(self, name: str, payload: Mapping[str, Any]) -> Mapping[str, Any]:
        raise GraphRequestError(f"{name}: this profile has no graph; submap_graph and corridor have one")

    def finish(self) -> FinishedGraph:
        return FinishedGraph()

    def close(self) -> None: ...
