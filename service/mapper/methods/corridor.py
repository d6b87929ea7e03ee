"""The default profile: every scan matched to surfels, odometry or IMU holding what the scan does not see."""

from service.fusion.estimator import Estimator, EstimatorConfig
from service.mapper.filters.deskew import BeamsConfig, DeskewByTwist
from service.mapper.filters.keep_all import keep_all
from service.mapper.graph.loop_closing import LoopClosing
from service.mapper.graph.loops_config import LoopsConfig
from service.mapper.graph.no_graph import NoGraph
from service.mapper.graph.rehearsal import rehearse
from service.mapper.maps.occupancy import OccupancyConfig, OccupancyTiles
from service.mapper.maps.submaps import SubmapsConfig, SurfelSubmaps
from service.mapper.matchers.rehearsal import rehearse_match, rehearse_search
from service.mapper.matchers.surfel_gauss_newton import SurfelGaussNewton, SurfelMatcherConfig
from service.mapper.stages import Method, NoSettings, StageKind

ESTIMATOR = StageKind("estimator", EstimatorConfig, lambda config, _: Estimator(config))
DESKEW_BY_TWIST = StageKind(
    "deskew_by_twist", BeamsConfig, lambda config, around: DeskewByTwist(config, around.mountings)
)
SURFEL_GAUSS_NEWTON = StageKind(
    "surfel_gauss_newton",
    SurfelMatcherConfig,
    lambda config, _: SurfelGaussNewton(config),
    reads=SurfelSubmaps,
    rehearse=rehearse_search,
    rehearse_core=rehearse_match,
)
SURFEL_SUBMAPS = StageKind(
    "surfel_submaps", SubmapsConfig, lambda config, _: SurfelSubmaps(config), makes=SurfelSubmaps
)
KEEP_ALL = StageKind("keep_all", NoSettings, lambda _, __: keep_all)
NO_GRAPH = StageKind("no_graph", NoSettings, lambda _, __: NoGraph())
LOOP_CLOSING = StageKind(
    "loop_closing",
    LoopsConfig,
    lambda config, around: LoopClosing(config, around.painter, around.new_worker),
    rehearse=rehearse,
)
OCCUPANCY_TILES = StageKind(
    "occupancy_tiles", OccupancyConfig, lambda config, around: OccupancyTiles(config, around.cell_m)
)

METHOD = Method(
    "corridor",
    stages={
        "motion_model": ESTIMATOR,
        "deskew": DESKEW_BY_TWIST,
        "matcher": SURFEL_GAUSS_NEWTON,
        "local_map": SURFEL_SUBMAPS,
        "keep_static": KEEP_ALL,
        "graph": LOOP_CLOSING,
        "free_space": OCCUPANCY_TILES,
    },
    settings={},
    others={"graph": (NO_GRAPH,)},
)
