"""Components of more than one profile."""

from collections.abc import Mapping
from typing import Any

from drivers.frames import GnssFix
from service.estimator.estimator import Estimator, EstimatorConfig
from service.geometry.se2 import SE2
from service.mapper.components import ComponentKind, FinishedGraph, GraphRequestError, MappedScan, NoSettings
from service.mapper.filters.deskew import BeamsConfig, DeskewByMotion, DeskewByTwist
from service.mapper.maps.occupancy import OccupancyConfig, OccupancyTiles

ESTIMATOR = ComponentKind("estimator", EstimatorConfig, lambda config, _: Estimator(config))
DESKEW_BY_TWIST = ComponentKind(
    "deskew_by_twist",
    BeamsConfig,
    lambda config, around: DeskewByTwist(config, around.mountings, around.outline_m),
)
DESKEW_BY_MOTION = ComponentKind(
    "deskew_by_motion",
    BeamsConfig,
    lambda config, around: DeskewByMotion(config, around.mountings, around.outline_m),
)
NO_GRAPH = ComponentKind("no_graph", NoSettings, lambda _, __: NoGraph())
OCCUPANCY_TILES = ComponentKind(
    "occupancy_tiles", OccupancyConfig, lambda config, around: OccupancyTiles(config, around.cell_m)
)


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
