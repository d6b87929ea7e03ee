"""The seams of the mapper: what each stage takes and gives. No algorithm lives here."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Generic, Literal, Protocol, TypeVar, get_args

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict

from drivers.frames import LaserScan
from service.fusion.motion import Motion, MotionModel, Prediction
from service.geometry.se2 import SE2
from service.outputs import State, TileUpdate


@dataclass(frozen=True, slots=True, eq=False)
class Points:
    """End points of one scan, those without a return left out, in beam order."""

    xy_base: npt.NDArray[np.float64]  # (N, 2) m, base frame at beam 0: motion during the sweep is taken out
    xy_raw: npt.NDArray[
        np.float64
    ]  # (N, 2) m, base frame at each beam's own moment: a matcher may deskew anew
    beam_time_s: npt.NDArray[np.float64]  # (N,) since beam 0
    beam: npt.NDArray[np.int32]  # (N,) which beam of the scan
    sensor_base: SE2  # pose of the sensor in the base frame (pose_base_sensor)
    scan: LaserScan


@dataclass(frozen=True, slots=True, eq=False)
class Match:
    """The motion after matching, and how good. score in [0, 1] is comparable within one matcher only."""

    motion: Motion
    points: Points  # deskewed with the matched twist
    score: float
    state: State = "ok"
    reason: str = ""
    submap: int | None = None  # which one was matched to, where a method has several


@dataclass(frozen=True, slots=True)
class MapChange:
    """What an insert did: the sub-map it closed, if any, and whether the scan entered as a key frame."""

    closed_submap: int | None = None
    is_keyframe: bool = False


class LocalMap(Protocol):
    """What a scan is matched to."""

    def insert(self, points: Points, match: Match) -> MapChange: ...


class FreeSpaceMap(Protocol):
    """What is shown and driven on: occupancy in tiles, in the map frame."""

    def insert(self, points: Points, pose_map_base: SE2) -> None: ...

    def changed_tiles(self) -> list[TileUpdate]:
        """Tiles that changed since the last call, each with a new version."""
        ...


ReadableMap = TypeVar("ReadableMap", bound=LocalMap)
ReadableMap_contra = TypeVar("ReadableMap_contra", bound=LocalMap, contravariant=True)


class Matcher(Protocol[ReadableMap_contra]):
    """A matcher names the map type it can read, so a wrong pairing fails in mypy, not on the road."""

    def match(self, points: Points, predicted: Prediction, local_map: ReadableMap_contra) -> Match: ...


class Graph(Protocol):
    def add(self, change: MapChange) -> SE2:
        """Take a change, give the newest pose_map_odom. Must not block: optimise elsewhere."""
        ...


class Stopwatch(Protocol):
    """Times the stages for the reader of a summary; has no say in any result."""

    def start(self) -> None: ...
    def lap(self, stage: str) -> None: ...


@dataclass(frozen=True, slots=True)
class Stages(Generic[ReadableMap]):
    """What stands in the boxes of one mapper."""

    motion_model: MotionModel
    deskew: Callable[[LaserScan, Motion], Points]
    matcher: Matcher[ReadableMap]
    local_map: ReadableMap
    keep_static: Callable[[Points, Match], Points]
    graph: Graph
    free_space: FreeSpaceMap


Box = Literal["motion_model", "deskew", "matcher", "local_map", "keep_static", "graph", "free_space"]
BOXES: tuple[Box, ...] = get_args(Box)  # the fields of Stages


@dataclass(frozen=True, slots=True)
class Surroundings:
    """What a stage is told besides its own settings."""

    cell_m: float  # of the shown map
    mountings: Mapping[str, SE2]  # pose_base_sensor of each laser, by its name


@dataclass(frozen=True, slots=True)
class StageKind:
    """Something that can stand in a box: its name in a config, its settings, and how it is made.

    makes   the class that build gives, where another stage reads it (local maps); else None
    reads   the class of the local map that this stage reads, None where it reads none
    """

    name: str
    config: type[BaseModel]
    build: Callable[[Any, Surroundings], Any]
    makes: type | None = None
    reads: type | None = None


class NoSettings(BaseModel):
    """Of a stage that has nothing to set."""

    model_config = ConfigDict(frozen=True, extra="forbid")


@dataclass(frozen=True, slots=True)
class Method:
    """A page that says which stages stand in the boxes, and with which settings where those are its own.

    settings   by box: keys whose values differ from the stage's defaults
    """

    name: str
    stages: Mapping[Box, StageKind]
    settings: Mapping[Box, Mapping[str, Any]]
