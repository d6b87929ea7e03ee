"""Settings of the default profile's graph."""

from pydantic import Field

from drivers.section import Section


class LoopsConfig(Section):
    """Spacing of key frames, drift of odometry, and path lengths for loop search."""

    keyframe_distance_m: float = Field(default=0.3, gt=0.0)
    keyframe_turn_rad: float = Field(default=0.15, gt=0.0)
    thin_m: float = Field(default=0.04, ge=0.0)  # least distance between two points of a key frame
    keep_passes: int = Field(default=6, ge=1)  # newest passes kept of a place, besides the first

    search_every_m: float = Field(default=2.0, gt=0.0)
    solve_at_m: float = Field(default=0.05, gt=0.0)  # residual of a loop that triggers a solution
    solve_at_rad: float = Field(default=0.01, gt=0.0)
    place_m: float = Field(default=5.0, gt=0.0)  # path length of a query, and of a sub-map to each side
    apart_m: float = Field(default=12.0, gt=0.0)  # least path length between two passes of a place
    consensus_span_m: float = Field(default=5.0, gt=0.0)  # path length over which loops must agree

    drift: float = Field(default=0.01, ge=0.0)  # m per m of path through the graph
    drift_radpm: float = Field(default=0.0015, ge=0.0)
