"""Qian et al. 2019: an IMU predicts, brute search on an orthogonally weighted likelihood map corrects it."""

from service.mapper.components import ComponentKind, Method
from service.mapper.methods.shared import DESKEW_BY_TWIST, NO_GRAPH, OCCUPANCY_TILES
from service.mapper.papers.owolm_eskf.brute_search import BruteSearch, BruteSearchConfig
from service.mapper.papers.owolm_eskf.inertial_motion import InertialMotion, InertialMotionConfig
from service.mapper.papers.owolm_eskf.orthogonal_map import OrthogonalMap, OrthogonalMapConfig

INERTIAL_MOTION = ComponentKind(
    "inertial_motion", InertialMotionConfig, lambda config, _: InertialMotion(config)
)
BRUTE_SEARCH = ComponentKind(
    "brute_search", BruteSearchConfig, lambda config, _: BruteSearch(config), reads=OrthogonalMap
)
ORTHOGONAL_MAP = ComponentKind(
    "orthogonal_map", OrthogonalMapConfig, lambda config, _: OrthogonalMap(config), makes=OrthogonalMap
)

METHOD = Method(
    "owolm_eskf",
    components={
        "motion_model": INERTIAL_MOTION,
        "deskew": DESKEW_BY_TWIST,
        "matcher": BRUTE_SEARCH,
        "local_map": ORTHOGONAL_MAP,
        "graph": NO_GRAPH,
        "free_space": OCCUPANCY_TILES,
    },
    settings={},
)
