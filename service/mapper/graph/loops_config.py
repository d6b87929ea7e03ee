"""Settings of the default profile's graph."""

from pydantic import BaseModel, ConfigDict, Field


class LoopsConfig(BaseModel):
    """Where loops are looked for, and when they are believed."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    keyframe_distance_m: float = Field(default=0.3, gt=0.0)
    keyframe_turn_rad: float = Field(default=0.15, gt=0.0)
    thin_m: float = Field(default=0.04, ge=0.0)  # points of a key frame lie no nearer to each other

    search_every_m: float = Field(default=2.0, gt=0.0)
    query_m: float = Field(default=5.0, gt=0.0)  # way whose key frames are looked for together
    place_m: float = Field(default=5.0, gt=0.0)  # way to each side that they are looked for in
    apart_m: float = Field(default=12.0, gt=0.0)  # way between two passes of a place, at least
    passes: int = Field(default=4, ge=1)  # that are asked in one search, the nearest ones
    window_m: float = Field(default=0.5, gt=0.0)
    window_growth: float = Field(default=0.035, ge=0.0)  # m for each m of way through the graph
    most_window_m: float = Field(default=12.0, gt=0.0)
    window_rad: float = Field(default=0.06, gt=0.0)
    window_growth_radpm: float = Field(default=0.006, ge=0.0)
    most_window_rad: float = Field(default=1.6, gt=0.0)
    least_score: float = Field(default=0.5, ge=0.0, le=1.0)

    least_share: float = Field(default=0.45, ge=0.0)  # of the points on the map, in medians of the drive
    doubtful_share: float = Field(default=0.6, ge=0.0)  # ... less, and the step to it may be wrong
    most_against: float = Field(default=0.12, ge=0.0, le=1.0)  # share of the points in free space
    group: int = Field(default=3, ge=2)  # loops that say the same, at least
    group_span_m: float = Field(default=5.0, ge=0.0)
    group_within_m: float = Field(default=30.0, gt=0.0)
    agree_m: float = Field(default=0.15, gt=0.0)
    agree_growth: float = Field(default=0.01, ge=0.0)
    agree_rad: float = Field(default=0.03, gt=0.0)
    agree_growth_radpm: float = Field(default=0.0015, ge=0.0)
    contradiction_chi2: float = Field(default=30.0, gt=0.0)  # a loop beyond it is laid aside
    reinstated_chi2: float = Field(default=9.0, gt=0.0)

    solve_at_m: float = Field(default=0.05, gt=0.0)  # what a new loop must move to be worth it before the end
    solve_at_rad: float = Field(default=0.01, gt=0.0)

    keep_passes: int = Field(default=6, ge=1)  # points are kept of so many passes, the newest
    finish_window_m: float = Field(default=1.5, gt=0.0)
    finish_window_rad: float = Field(default=0.2, gt=0.0)
    dense_m: float = Field(default=2.5, ge=0.0)  # passes this near are joined at each key frame; 0: not
    dense_passes: int = Field(default=4, ge=0)
    dense_most_m: float = Field(default=0.15, gt=0.0)  # farther from where they lay they are not believed
    dense_most_rad: float = Field(default=0.03, gt=0.0)
    dense_most: int = Field(default=20_000, ge=0)
