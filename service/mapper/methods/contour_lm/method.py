"""Li et al. 2016: matching to a learned map of blurred contours, with the laser's velocity estimated."""

from service.mapper.components import ComponentKind, Method
from service.mapper.methods.shared import DESKEW_BY_TWIST, ESTIMATOR, NO_GRAPH, OCCUPANCY_TILES
from service.mapper.papers.contour_lm.contour_map import ContourMap, ContourMapConfig
from service.mapper.papers.contour_lm.contour_matcher import ContourLm, ContourLmConfig

CONTOUR_LM = ComponentKind(
    "contour_lm", ContourLmConfig, lambda config, _: ContourLm(config), reads=ContourMap
)
CONTOUR_MAP = ComponentKind(
    "contour_map", ContourMapConfig, lambda config, _: ContourMap(config), makes=ContourMap
)

METHOD = Method(
    "contour_lm",
    components={
        "motion_model": ESTIMATOR,
        "deskew": DESKEW_BY_TWIST,
        "matcher": CONTOUR_LM,
        "local_map": CONTOUR_MAP,
        "graph": NO_GRAPH,
        "free_space": OCCUPANCY_TILES,
    },
    settings={"deskew": {"nearest_m": 0.5, "farthest_m": 20.0}},
)
