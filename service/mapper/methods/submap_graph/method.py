"""Zhang et al. 2016: particle-filtered sub-maps of counts, joined by virtual landmarks in a graph."""

from service.mapper.components import ComponentKind, Method
from service.mapper.methods.shared import DESKEW_BY_TWIST, ESTIMATOR, OCCUPANCY_TILES
from service.mapper.papers.submap_graph.counted_submaps import CountedSubmaps, CountedSubmapsConfig
from service.mapper.papers.submap_graph.graph.landmark_back_end import LandmarkGraphConfig
from service.mapper.papers.submap_graph.graph.landmark_graph import LandmarkGraph
from service.mapper.papers.submap_graph.particle_filter import ParticleFilter, ParticleFilterConfig

COUNTED_SUBMAPS = ComponentKind(
    "counted_submaps", CountedSubmapsConfig, lambda config, _: CountedSubmaps(config), makes=CountedSubmaps
)
PARTICLE_FILTER = ComponentKind(
    "particle_filter", ParticleFilterConfig, lambda config, _: ParticleFilter(config), reads=CountedSubmaps
)
LANDMARK_GRAPH = ComponentKind(
    "landmark_graph",
    LandmarkGraphConfig,
    lambda config, around: LandmarkGraph(config, around.renderer, around.new_worker),
    reads=CountedSubmaps,
)

METHOD = Method(
    "submap_graph",
    components={
        "motion_model": ESTIMATOR,
        "deskew": DESKEW_BY_TWIST,
        "matcher": PARTICLE_FILTER,
        "local_map": COUNTED_SUBMAPS,
        "graph": LANDMARK_GRAPH,
        "free_space": OCCUPANCY_TILES,
    },
    settings={},
)
