"""A vehicle in a room, without devices and mapper: the messages and tiles that a service would put out."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from drivers.frames import NO_INTENSITY, LaserScan
from service.encoding import (
    Message,
    Status,
    encode_diagnostics,
    encode_event,
    encode_frame,
    encode_pose,
    encode_tf_static,
)
from service.geometry.se2 import SE2
from service.mapstore.tiles import TileStore
from service.outputs import FREE, NO_REASON, OCCUPIED, UNKNOWN, MapperOutput, TileUpdate

CELL_M, EDGE = 0.05, 64
FIRST_NS = 1_700_000_000_000_000_000
MOUNTINGS = {"front": SE2(0.2, 0.0, 0.0), "rear": SE2(-0.2, 0.0, math.pi)}
COVARIANCE = np.array([[4e-4, 1e-4, 0.0], [1e-4, 1e-4, 0.0], [0.0, 0.0, 1e-4]])


@dataclass
class Scene:
    """A room of (2 * half_x_m) x (2 * half_y_m) around the origin, with walls one cell thick."""

    half_x_m: float = 8.0
    half_y_m: float = 5.0
    store: TileStore = field(default_factory=TileStore)

    def cells(self) -> np.ndarray:
        """(H, W) int8 of whole tiles around the origin; see `tiles`."""
        columns, rows = self._tiles_to_a_side()
        y, x = np.mgrid[-rows * EDGE : rows * EDGE, -columns * EDGE : columns * EDGE]
        across, up = round(self.half_x_m / CELL_M), round(self.half_y_m / CELL_M)
        inside = (abs(x + 0.5) < across) & (abs(y + 0.5) < up)
        within = (abs(x + 0.5) < across - 1) & (abs(y + 0.5) < up - 1)
        return np.where(within, FREE, np.where(inside, OCCUPIED, UNKNOWN)).astype(np.int8)

    def tiles(self) -> list[TileUpdate]:
        cells = self.cells()
        columns, rows = self._tiles_to_a_side()
        tiles = []
        for iy in range(-rows, rows):
            for ix in range(-columns, columns):
                row, column = (iy + rows) * EDGE, (ix + columns) * EDGE
                square = cells[row : row + EDGE, column : column + EDGE].copy()
                version = self.store.version + len(tiles) + 1
                tiles.append(TileUpdate(0, ix, iy, version, CELL_M, square))
        return tiles

    def map_all(self) -> None:
        self.store.update(self.tiles())

    def pose(self, seconds: float) -> SE2:
        """On a circle of 2 m, 0.5 rad/s."""
        angle = 0.5 * seconds
        return SE2(2.0 * math.cos(angle), 2.0 * math.sin(angle), angle + math.pi / 2)

    def scan(self, name: str, seconds: float, beams: int = 361) -> LaserScan:
        """What a laser would measure from a vehicle that stands still there."""
        sensor = self.pose(seconds) @ MOUNTINGS[name]
        first, step = -math.pi / 2, math.pi / (beams - 1)
        ranges = []
        for k in range(beams):
            angle = sensor.theta_rad + first + k * step
            c, s = math.cos(angle), math.sin(angle)
            to_x = ((self.half_x_m if c > 0 else -self.half_x_m) - sensor.x_m) / c if c else math.inf
            to_y = ((self.half_y_m if s > 0 else -self.half_y_m) - sensor.y_m) / s if s else math.inf
            ranges.append(min(to_x, to_y))
        stamp_ns = stamp(seconds)
        return LaserScan(
            name, stamp_ns, stamp_ns + 5_000_000, 0, 20_000_000, first, step, 0.05, 30.0,
            np.array(ranges, np.float32), NO_INTENSITY,
        )  # fmt: skip

    def messages(self, seconds: float, state: str = "ok", reason: str = "") -> list[Message]:
        """Mountings, a pose, a scan of each laser, health: all at one moment."""
        stamp_ns = stamp(seconds)
        scans = [encode_frame(self.scan(name, seconds), log_ns=stamp_ns + 5_000_000) for name in MOUNTINGS]
        return [
            encode_tf_static(MOUNTINGS, stamp_ns, stamp_ns),
            encode_pose(self.output(seconds), stamp_ns + 8_000_000),
            *scans,
            encode_diagnostics("diagnostics", statuses(state, reason), stamp_ns, stamp_ns),
        ]

    def output(self, seconds: float) -> MapperOutput:
        twist = (1.0, 0.0, 0.5)
        return MapperOutput(
            stamp(seconds), self.pose(seconds), SE2(), twist, COVARIANCE, "ok", NO_REASON, 0.9
        )

    def _tiles_to_a_side(self) -> tuple[int, int]:
        edge_m = EDGE * CELL_M
        return math.ceil(self.half_x_m / edge_m), math.ceil(self.half_y_m / edge_m)


def stamp(seconds: float) -> int:
    return FIRST_NS + round(seconds * 1e9)


def event(text: str, seconds: float) -> Message:
    return encode_event(text, stamp(seconds), stamp(seconds))


def statuses(state: str = "ok", reason: str = "") -> Sequence[Status]:
    level = {"ok": 0, "degraded": 1, "lost": 2, "paused": 1}[state]
    sensor = {"state": "streaming", "rate_hz": "50.0", "age_s": "0.02", "dropped": "0", "frames": "512"}
    down = {"state": "down", "rate_hz": "0.0", "reason_id": "link_down"}
    mapping = {"state": state, "inlier_ratio": "0.930", "scan_rate_hz": "50.0", "scans_dropped": "3",
               "scan_cpu_ms_p50": "0.912", "scans": "18808"}  # fmt: skip
    recording = {"state": "recording", "file": "/tmp/veh1_20260101T000000Z_0001.mcap", "messages": "12345",
                 "free_gb": "41.2"}  # fmt: skip
    return [
        Status("sensor/front", 0, "ok", {**sensor, "device_clock_s": "8130", "clock_sigma_ms": "0.21"}),
        Status("sensor/rear", 2, "no route to 192.168.0.10", {**sensor, **down}),
        Status("mapping", level, reason or state, mapping),
        Status("map", 0, "ok", {"folder": "/tmp/map", "saved_version": "7"}),
        Status("recording", 0, "recording", recording),
        Status("zenoh", 0, "ok", {}),
    ]
