"""The default profile: every scan matched to surfels, odometry or IMU holding what the scan does not see."""

from collections.abc import Mapping

from pydantic import BaseModel, ConfigDict

from service.fusion.weighed_motion import MotionConfig, WeighedMotion
from service.geometry.se2 import SE2
from service.mapper.filters.deskew import BeamsConfig, DeskewByTwist
from service.mapper.filters.keep_all import keep_all
from service.mapper.graph.no_graph import NoGraph
from service.mapper.maps.occupancy import OccupancyConfig, OccupancyTiles
from service.mapper.maps.submaps import NormalsConfig, SubmapsConfig, SurfelSubmaps
from service.mapper.matchers.surfel_gauss_newton import SurfelGaussNewton, SurfelMatcherConfig
from service.mapper.stages import Stages


class CorridorConfig(BaseModel):
    """All parameters of the profile, each beside the stage that it belongs to."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    beams: BeamsConfig = BeamsConfig()
    motion: MotionConfig = MotionConfig()
    normals: NormalsConfig = NormalsConfig()
    matcher: SurfelMatcherConfig = SurfelMatcherConfig()
    submaps: SubmapsConfig = SubmapsConfig()
    occupancy: OccupancyConfig = OccupancyConfig()


def assemble(config: CorridorConfig, cell_m: float, mountings: Mapping[str, SE2]) -> Stages[SurfelSubmaps]:
    return Stages(
        motion_model=WeighedMotion(config.motion),
        deskew=DeskewByTwist(config.beams, mountings),
        matcher=SurfelGaussNewton(config.matcher, config.normals),
        local_map=SurfelSubmaps(config.submaps, config.normals),
        keep_static=keep_all,
        graph=NoGraph(),
        free_space=OccupancyTiles(config.occupancy, cell_m),
    )
