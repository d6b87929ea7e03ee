"""The default profile: every scan matched to surfels, odometry or IMU holding what the scan does not see."""

from service.mapper.components import ComponentKind, Method
from service.mapper.matchers.search_warm_up import warm_up_search
from service.mapper.methods.corridor.graph.loop_closing import LoopClosing
from service.mapper.methods.corridor.graph.loops_config import LoopsConfig
from service.mapper.methods.corridor.graph.warm_up import warm_up
from service.mapper.methods.corridor.insert_warm_up import warm_up_insert
from service.mapper.methods.corridor.match_warm_up import warm_up_match
from service.mapper.methods.corridor.submaps import SubmapsConfig, SurfelSubmaps
from service.mapper.methods.corridor.surfel_gauss_newton import SurfelGaussNewton, SurfelMatcherConfig
from service.mapper.methods.shared import (
    DESKEW_BY_MOTION,
    DESKEW_BY_TWIST,
    ESTIMATOR,
    NO_GRAPH,
    OCCUPANCY_TILES,
)

SURFEL_GAUSS_NEWTON = ComponentKind(
    "surfel_gauss_newton",
    SurfelMatcherConfig,
    lambda config, _: SurfelGaussNewton(config),
    reads=SurfelSubmaps,
    warm_up=warm_up_search,
    warm_up_core=warm_up_match,
)
SURFEL_SUBMAPS = ComponentKind(
    "surfel_submaps",
    SubmapsConfig,
    lambda config, _: SurfelSubmaps(config),
    makes=SurfelSubmaps,
    warm_up_core=warm_up_insert,
)
LOOP_CLOSING = ComponentKind(
    "loop_closing",
    LoopsConfig,
    lambda config, around: LoopClosing(
        config,
        around.renderer,
        around.new_worker,
        around.mountings,
        around.stored,
        around.is_localizing,
        around.keep_graph,
    ),
    warm_up=warm_up,
    begins_in_stored=True,
)

METHOD = Method(
    "corridor",
    components={
        "motion_model": ESTIMATOR,
        "deskew": DESKEW_BY_MOTION,
        "matcher": SURFEL_GAUSS_NEWTON,
        "local_map": SURFEL_SUBMAPS,
        "graph": LOOP_CLOSING,
        "free_space": OCCUPANCY_TILES,
    },
    settings={},
    others={"graph": (NO_GRAPH,), "deskew": (DESKEW_BY_TWIST,)},
)
