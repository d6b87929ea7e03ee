"""Components of more than one profile."""

from service.estimator.estimator import Estimator, EstimatorConfig
from service.mapper.components import ComponentKind, NoSettings
from service.mapper.filters.deskew import BeamsConfig, DeskewByMotion, DeskewByTwist
from service.mapper.graph.model.no_graph import NoGraph
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
    "occupancy_tiles",
    OccupancyConfig,
    lambda config, around: OccupancyTiles(config, around.cell_m),
)
