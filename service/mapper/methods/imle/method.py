"""Tang et al. 2014: ICP narrows the window, exhaustive search on a likelihood map in patches decides."""

from service.mapper.components import ComponentKind, Method
from service.mapper.methods.shared import DESKEW_BY_TWIST, ESTIMATOR, NO_GRAPH, OCCUPANCY_TILES
from service.mapper.papers.imle.icp_then_search import IcpThenSearch, IcpThenSearchConfig
from service.mapper.papers.imle.monte_carlo import MonteCarloConfig, MonteCarloSearch
from service.mapper.papers.imle.patch_map import PatchMap, PatchMapConfig
from service.mapper.papers.imle.scan_icp import IcpScanToScan, IcpScanToScanConfig

PATCH_MAP = ComponentKind(
    "patch_map",
    PatchMapConfig,
    lambda config, around: PatchMap(config, around.new_patch_store),
    makes=PatchMap,
)
ICP_THEN_SEARCH = ComponentKind(
    "icp_then_search", IcpThenSearchConfig, lambda config, _: IcpThenSearch(config), reads=PatchMap
)
ICP_SCAN_TO_SCAN = ComponentKind(
    "icp_scan_to_scan", IcpScanToScanConfig, lambda config, _: IcpScanToScan(config), reads=PatchMap
)
MONTE_CARLO = ComponentKind(
    "monte_carlo", MonteCarloConfig, lambda config, _: MonteCarloSearch(config), reads=PatchMap
)

METHOD = Method(
    "imle",
    components={
        "motion_model": ESTIMATOR,
        "deskew": DESKEW_BY_TWIST,
        "matcher": ICP_THEN_SEARCH,
        "local_map": PATCH_MAP,
        "graph": NO_GRAPH,
        "free_space": OCCUPANCY_TILES,
    },
    settings={"deskew": {"farthest_m": 20.0}},
    others={"matcher": (ICP_SCAN_TO_SCAN, MONTE_CARLO)},
)
