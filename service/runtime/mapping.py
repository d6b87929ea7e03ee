"""The mapping thread: frames in order of arrival -> recording, subscribers and mapper."""

import json
import logging
import math
import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from drivers.frames import Frame, LaserScan
from service.encoding import (
    TAKE_IN,
    LogClock,
    Message,
    decode_frame,
    encode_event,
    encode_frame,
    encode_odom,
    encode_pose,
    encode_tf,
)
from service.mapper.steering import SteeredMapper, Steering
from service.mapstore.tiles import TileStore
from service.outputs import MapperOutput, TileUpdate
from service.runtime.host_time import HostTime
from service.runtime.metrics import LatencyHistogram
from service.runtime.queues import Command, FrameQueue

log = logging.getLogger(__name__)

IDLE_S = 0.2  # how long to wait for a frame before the loop beats anyway
TILE_INTERVAL_NS = 200_000_000


class MapperError(Exception):
    """The mapper cannot be trusted any more; the recording ends with the frame that did it."""


class MappingLoop:
    """Owns the mapper. Waits for nothing but the next frame: `publish` and `record` only queue.

    The mapper eats what the recording holds: each frame is encoded once, and what is decoded from those very
    bytes goes on, so a replay of the file gives the same poses. Commands stand among the frames, there too.

    publish    takes a message and, for a pose, the moment its scan's last byte was read (host monotonic, ns)
    record     takes a message
    on_tiles   takes tiles that the store holds by now, and the Unix time of the scan they are up to
    """

    def __init__(
        self,
        queue: FrameQueue,
        mapper: SteeredMapper,
        tiles: TileStore,
        host_time: HostTime,
        publish: Callable[[Message, int | None], Any],
        record: Callable[[Message], Any],
        on_tiles: Callable[[list[TileUpdate], int], Any],
    ) -> None:
        self._queue = queue
        self._mapper = mapper
        self._tiles = tiles
        self._host_time = host_time
        self._publish = publish
        self._record = record
        self._on_tiles = on_tiles
        self._log_clock = LogClock()
        self._tiles_due_ns = 0
        self._map_stamp_ns = 0  # Unix time of the newest scan in the map
        self._began_version = 0  # the map's versions count from here
        self.heartbeat = 0  # rises as long as the loop turns, with or without frames
        self.last_output: MapperOutput | None = None
        self.states: Counter[str] = Counter()  # scans by state: ok, degraded, lost
        self.scan_cpu = LatencyHistogram()  # processor time of this thread in the mapper, by scan mapped
        self.unusable_scans = 0  # of the laser that is mapped
        self.unusable: Counter[str] = Counter()  # frames that hold nothing to map, by sensor

    @property
    def counters(self) -> Counter[str]:
        """The mapper's own: scans, scans_dropped_late ..."""
        return self._mapper.counters

    @property
    def laser(self) -> str | None:
        """Whose scans are mapped."""
        return self._mapper.laser

    @property
    def graph_trouble(self) -> str:
        """Why no loop is closed any more, "" while all is well."""
        return self._mapper.graph_trouble

    @property
    def paused(self) -> bool:
        return self._mapper.paused

    def run(self) -> None:
        """Map until the queue is closed and empty. Raises MapperError."""
        while not self._queue.drained:
            self.heartbeat += 1
            item = self._queue.get(IDLE_S)
            if item is not None and self._mapper.work_ready:
                self._take_in(item.arrived_ns)
            if isinstance(item, Command):
                self._carry_out(item)
            elif item is not None:
                self._take(item)
            if time.monotonic_ns() >= self._tiles_due_ns:
                self.hand_over_tiles()
        self._mapper.finish()
        self.hand_over_tiles()

    def steer(self, steering: Steering) -> bool:
        """Pause, resume or reset the mapper; whether that changed anything. For commands, between frames."""
        if steering == "reset_map":
            self.hand_over_tiles()
            emptied = self._tiles.begin_anew()
            if emptied:
                self._on_tiles(emptied, self._map_stamp_ns)
            self._began_version = self._tiles.version
            self.last_output = None
        return self._mapper.steer(steering)

    def wish(self, name: str, payload: Mapping[str, Any]) -> Mapping[str, Any]:
        """As Graph.wish; for commands, between frames. Raises WishError."""
        return self._mapper.wish(name, payload)

    def hand_over_tiles(self) -> None:
        """Bring tile store and subscribers up to the newest scan. For commands, between frames."""
        self._tiles_due_ns = time.monotonic_ns() + TILE_INTERVAL_NS
        changed = self._mapper.changed_tiles()
        if changed:
            changed = [replace(tile, version=self._began_version + tile.version) for tile in changed]
            self._tiles.update(changed)
            self._on_tiles(changed, self._map_stamp_ns)

    def _carry_out(self, command: Command) -> None:
        log_ns = self._log_clock.next_ns(self._host_time.unix_ns(command.arrived_ns))
        command.carry_out(encode_event(json.dumps(dict(command.event)), log_ns, log_ns))

    def _take_in(self, arrived_ns: int) -> None:
        """Bring in work of the graph, and record at which place among the frames that was."""
        log_ns = self._log_clock.next_ns(self._host_time.unix_ns(arrived_ns))
        self._mapper.take_in()
        trouble = self._mapper.graph_trouble
        event = {"event": "graph_lost", "reason": trouble} if trouble else {"event": TAKE_IN}
        self._record(encode_event(json.dumps(event), log_ns, log_ns))

    def _take(self, frame: Frame) -> None:
        log_ns = self._log_clock.next_ns(self._host_time.unix_ns(frame.arrived_ns))
        message = encode_frame(frame, self._host_time.offset_ns, log_ns)
        self._record(message)
        self._publish(message, None)
        eaten = decode_frame(message.type, message.payload, frame.sensor, log_ns)
        if eaten is None:
            self.unusable[frame.sensor] += 1
            self.unusable_scans += isinstance(frame, LaserScan) and frame.sensor == self.laser
            return
        output = self._map(eaten)
        if output is None:
            return
        self.last_output, self._map_stamp_ns = output, output.stamp_ns
        self.states[output.state] += 1
        pose, odom, tf = encode_pose(output, log_ns), encode_odom(output, log_ns), encode_tf(output, log_ns)
        self._publish(pose, frame.arrived_ns)
        for message in (odom, tf):
            self._publish(message, None)
        for message in (pose, odom, tf):
            self._record(message)

    def _map(self, frame: Frame) -> MapperOutput | None:
        """One frame through the mapper. What it holds after an exception nobody knows, so none passes."""
        kind = "scan" if isinstance(frame, LaserScan) else "sample"
        before_cpu_ns = time.thread_time_ns()
        try:
            output = self._mapper.process(frame)
        except Exception as error:
            raise MapperError(f"{kind} of {frame.sensor} stamped {frame.stamp_ns}: {error!r}") from error
        if output is not None:
            self.scan_cpu.add(time.thread_time_ns() - before_cpu_ns)
            pose = output.pose_map_base
            if not all(map(math.isfinite, (pose.x_m, pose.y_m, pose.theta_rad))):
                raise MapperError(f"{kind} of {frame.sensor} stamped {frame.stamp_ns} gave the pose {pose}")
        return output
