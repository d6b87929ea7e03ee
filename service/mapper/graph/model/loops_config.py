"""Settings of the default profile's graph."""

from pydantic import Field

from drivers.section import Section


class LoopsConfig(Section):
    """How finely the way is kept, how far it may have drifted, and over which way loops are looked for."""

    keyframe_distance_m: float = Field(default=0.3, gt=0.0)
    keyframe_turn_rad: float = Field(default=0.15, gt=0.0)
    thin_m: float = Field(default=0.04, ge=0.0)  # points of a key frame lie no nearer to each other
    keep_passes: int = Field(default=6, ge=1)  # passes of a spot that are kept, the newest, besides the first

    search_every_m: float = Field(default=2.0, gt=0.0)
    solve_at_m: float = Field(default=0.05, gt=0.0)  # what a loop must move to be worth a solution now
    solve_at_rad: float = Field(default=0.01, gt=0.0)
    place_m: float = Field(default=5.0, gt=0.0)  # way that is looked for, and way to each side of where it is
    apart_m: float = Field(default=12.0, gt=0.0)  # way between two passes of a place, at least
    consensus_span_m: float = Field(default=5.0, gt=0.0)  # way over which loops must say the same

    drift: float = Field(default=0.01, ge=0.0)  # m for each m of way through the graph
    drift_radpm: float = Field(default=0.0015, ge=0.0)
