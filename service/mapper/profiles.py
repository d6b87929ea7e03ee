"""Profile name -> its config and its assembly. The only module that knows methods by name.

Another profile is another module in methods/ and a line in PROFILES.
"""

import math
from collections.abc import Callable, Mapping
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, field_validator

from drivers.frames import NO_INTENSITY, ImuSample, LaserScan, OdometrySample
from service.geometry.se2 import SE2
from service.mapper.methods import corridor
from service.mapper.methods.corridor import CorridorConfig
from service.mapper.pipeline import Mapper
from service.mapper.stages import Stages, Stopwatch

PROFILES: dict[str, Callable[[Any, float, Mapping[str, SE2]], Stages[Any]]] = {
    "corridor": corridor.assemble,
}


class MappingConfig(BaseModel):
    """Which method maps, with which parameters, and how fine the shown map is."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    profile: Literal["corridor"] = "corridor"
    cell_m: float = Field(default=0.05, ge=0.01, le=0.5)
    mode: Literal["mapping"] = "mapping"
    lasers: tuple[str, ...] | None = None  # whose scans are mapped; None: those of the first laser
    settings: CorridorConfig = CorridorConfig()

    @field_validator("lasers")
    @classmethod
    def _one(cls, lasers: tuple[str, ...] | None) -> tuple[str, ...] | None:
        if lasers is not None and len(lasers) != 1:
            raise ValueError(
                f"one laser is mapped, not {len(lasers)}; name one of them, or leave lasers out. "
                "The scans of the others are published and recorded all the same"
            )
        return lasers


def build_mapper(
    config: MappingConfig, mountings: Mapping[str, SE2], stopwatch: Stopwatch | None = None
) -> Mapper[Any]:
    """A mapper that has seen nothing yet. mountings: pose_base_sensor of each laser, by its name."""
    stages = PROFILES[config.profile](config.settings, config.cell_m, mountings)
    return Mapper(stages, stopwatch)


def warm_up() -> None:
    """Compile every kernel of every profile, or load it from the cache: seconds, or a fifth of one.

    Drives each mapper a little way through a made-up room, so that kernels meet the very types of a real run.
    """
    for profile in PROFILES:
        mapper = build_mapper(MappingConfig.model_validate({"profile": profile}), {"laser": SE2()})
        for k in range(4):
            stamp_ns = k * 100_000_000
            x_m = 0.4 * k
            mapper.process(ImuSample("imu", stamp_ns, stamp_ns, (0.0, 0.0, 0.0), (0.0, 0.0, 9.81)))
            mapper.process(
                OdometrySample("base", stamp_ns, stamp_ns, x_m, 0.0, 0.0, (4.0, 0.0, 0.0), (0.0,) * 9)
            )
            mapper.process(_room_scan(stamp_ns, x_m))
        mapper.changed_tiles()


def _room_scan(stamp_ns: int, x_m: float) -> LaserScan:
    """What a laser at (x, 0) sees of a room from -3 to 5 m by -2 to 2 m."""
    angle = np.linspace(-2.3, 2.3, 181)
    with np.errstate(divide="ignore"):
        to_side = 2.0 / np.abs(np.sin(angle))
        to_end = np.where(np.cos(angle) > 0.0, 5.0 - x_m, 3.0 + x_m) / np.abs(np.cos(angle))
    return LaserScan(
        sensor="laser",
        stamp_ns=stamp_ns,
        arrived_ns=stamp_ns,
        beam_interval_ns=10_000,
        scan_period_ns=100_000_000,
        first_angle_rad=-2.3,
        angle_step_rad=4.6 / 180,
        range_min_m=0.05,
        range_max_m=math.inf,
        range_m=np.minimum(to_side, to_end).astype(np.float32),
        intensity=NO_INTENSITY,
    )
