"""One laser's mapper that can be paused and begun anew between two frames, live and in a replay alike."""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal, Protocol

from drivers.frames import Frame, LaserScan
from service.geometry.se2 import SE2
from service.outputs import MapperOutput, TileUpdate

Steering = Literal["pause", "resume", "reset_map"]


@dataclass(frozen=True, slots=True)
class Control:
    """A wish with its place among the frames: it holds for those after it."""

    steering: Steering
    arrived_ns: int  # as that of a frame


class FrameMapper(Protocol):
    """service.mapper.pipeline.Mapper, whatever map it matches to."""

    counters: Counter[str]

    def process(self, frame: Frame) -> MapperOutput | None: ...
    def skip(self, scan: LaserScan) -> None: ...
    def changed_tiles(self) -> list[TileUpdate]: ...


class SteeredMapper:
    """Frames and wishes in, outputs out. Same order in, same outputs out.

    Of several lasers one is mapped, `laser`: their sweeps overlap in time, and what is older than the newest
    scan mapped would be late. Scans of the others are counted and pass. None: no laser is mapped.

    In a pause no scan is mapped and no pose comes out; samples go on to the motion model, so that it knows
    the way driven meanwhile. A reset puts a fresh mapper in the place of the old: map and `pose_map_base`
    begin anew, while `pose_odom_base` goes on where it was, because odom never jumps.
    """

    def __init__(self, new_mapper: Callable[[], FrameMapper], laser: str | None) -> None:
        self.laser = laser
        self._new_mapper = new_mapper
        self._mapper = new_mapper()
        self._last_odom: tuple[int, SE2] | None = None  # stamp and pose of the newest output
        self._began: tuple[int, SE2] | None = None  # that of the newest output before the last reset
        self.counters = self._mapper.counters  # those of the mapper, going on over resets
        self.paused = False

    def process(self, frame: Frame) -> MapperOutput | None:
        """As Mapper.process. A scan that is older than one mapped before a reset is dropped as late."""
        if not isinstance(frame, LaserScan):
            return self._mapper.process(frame)
        if frame.sensor != self.laser:
            self.counters["scans_not_mapped"] += 1
            return None
        if self._began is not None and frame.stamp_ns <= self._began[0]:
            self.counters["scans_dropped_late"] += 1
            return None
        if self.paused:
            self.counters["scans_paused"] += 1
            self._mapper.skip(frame)
            return None
        output = self._mapper.process(frame)
        if output is None:
            return None
        output = self._in_one_odom(output)
        self._last_odom = (output.stamp_ns, output.pose_odom_base)
        return output

    def steer(self, steering: Steering) -> bool:
        """Whether that changed anything: a pause in a pause does not."""
        if steering == "reset_map":
            self._mapper = self._new_mapper()
            self._mapper.counters = self.counters
            self._began = self._last_odom
            self.counters["map_resets"] += 1
            return True
        paused, self.paused = self.paused, steering == "pause"
        return self.paused != paused

    def changed_tiles(self) -> list[TileUpdate]:
        """As Mapper.changed_tiles; versions begin anew with each reset."""
        return self._mapper.changed_tiles()

    def _in_one_odom(self, output: MapperOutput) -> MapperOutput:
        if self._began is None:
            return output
        pose_odom_start = self._began[1]  # where the map began, in odom
        return replace(
            output,
            pose_odom_base=pose_odom_start @ output.pose_odom_base,
            pose_map_odom=output.pose_map_odom @ pose_odom_start.inverse(),
        )
