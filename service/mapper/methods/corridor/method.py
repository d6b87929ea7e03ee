"""The default profile: scans matched to surfels; odometry or IMU fix what the scan leaves open."""

from service.mapper.components import ComponentKind, Method
from service.mapper.graph.loops.loop_closing import LoopClosing
from service.mapper.graph.model.keyframe_list import LoopsConfig
from service.mapper.methods.shared import (
    DESKEW_BY_MOTION,
    DESKEW_BY_TWIST,
    ESTIMATOR,
    NO_GRAPH,
    OCCUPANCY_TILES,
)
from service.mapper.scan_match.submaps import SubmapsConfig, SurfelSubmaps
from service.mapper.scan_match.surfel_gauss_newton import SurfelGaussNewton, SurfelMatcherConfig

SURFEL_GAUSS_NEWTON = ComponentKind(
    "surfel_gauss_newton",
    SurfelMatcherConfig,
    lambda config, _: SurfelGaussNewton(config),
    reads=SurfelSubmaps,
)
SURFEL_SUBMAPS = ComponentKind(
    "surfel_submaps", SubmapsConfig, lambda config, _: SurfelSubmaps(config), makes=SurfelSubmaps
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
