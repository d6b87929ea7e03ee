"""Messages to and from a browser, as bytes. No socket and no clock.

To the browser, text is JSON with a "type"; binary begins with a kind:

    TILES   u8 1, u8 0, u16 tile_cells, f32 cell_m, u32 count, then zlib of
            count x (i32 ix, i32 iy) and count x tile_cells^2 x i8 (-1 unknown, 0..100 per cent occupied)
    SCAN    u8 2, u8 name_bytes, u16 beams, f64 stamp_s (Unix), f32 first_angle_rad, f32 angle_step_rad,
            f32 beam_interval_s, the name in UTF-8, then beams x u16 in RANGE_STEP_M, 0 = no return,
            FIRST_CAUSE + k = none, for the cause k of drivers.frames.CAUSES, which `hello` names
    PATH    u8 3, u8 how, u16 0, u32 count, count x (f32 x_m, f32 y_m), map frame;
            how 0: in place of the path so far, 1: behind it
    GRAPH   u8 4, u8 0, u16 0, then zlib of u32 paths, u32 borders, u32 accepted, u32 refused; a u32 count of
            points for each path and each border; the points of paths and borders, then both ends of each
            accepted and of each refused loop, as (f32 x_m, f32 y_m), map frame; then JSON: what some of the
            loops rest on, {"accepted": [...], "refused": [...]}, see service.mapper.loop_evidence

    STANDING u8 5, u8 known, u16 0, f32 cell_m, i32 column, i32 row of the lower left cell, counted from the
            map's origin, u32 width, u32 height, then zlib of width x height x i8 by rows (-1 nothing stands,
            1..100 for how long something has, per cent of what counts in full); known 0: nothing is known
    CHANGED u8 6, else as STANDING (-1 as in the stored map, 100 occupied now, 0 what was there is
            gone); known 0: no one watches

All little-endian. From the browser only text comes: see `Asked`.
"""

import json
import struct
import zlib
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal

import numpy as np
import numpy.typing as npt
from pydantic import Field, TypeAdapter, ValidationError

from drivers.frames import LaserScan, causes_of
from drivers.section import Section
from service.encoding import Pose, Status
from service.errors import fault_words
from service.geometry.se2 import SE2
from service.outputs import GraphPicture, Grid, TileUpdate
from service.web.series import Row

TILES, SCAN, PATH, GRAPH, STANDING, CHANGED = 1, 2, 3, 4, 5, 6
RANGE_STEP_M = 0.005  # a tenth of a cell; up to FIRST_CAUSE, 326 m
FIRST_CAUSE = 65_280
LARGEST_ASKED = 65_536  # bytes of one message from a browser
DEFLATE_LEVEL = 1  # tiles are mostly of one value; higher levels cost more than they save

FloatArray = npt.NDArray[np.float32]


class TokenShown(Section):
    """Requests the right to make changes."""

    type: Literal["token"]
    token: Annotated[str, Field(max_length=200)]


class CommandRequest(Section):
    """A command of docs/commands.md; `n` comes back with the answer."""

    type: Literal["command"]
    n: Annotated[int, Field(ge=0, lt=2**53)]
    verb: Annotated[str, Field(min_length=1, max_length=40)]
    request: dict[str, Any] = Field(default_factory=dict)


class ResourceRequest(Section):
    """Something about stored sessions and maps, see resources.py; only to list them needs no token.

    to        rename: the new name; download: the format; undo: the number that delete gave
    request   keyframe and edit: what service.offline.maps.session_commands receives
    """

    type: Literal["resource"]
    n: Annotated[int, Field(ge=0, lt=2**53)]
    action: Literal["list", "rename", "delete", "undo", "download", "look", "keyframe"]
    kind: Literal["session", "map"] = "session"
    name: Annotated[str, Field(max_length=255)] = ""
    to: Annotated[str, Field(max_length=255)] = ""
    request: dict[str, Any] = Field(default_factory=dict)


BrowserRequest = TokenShown | CommandRequest | ResourceRequest
_ASKED: TypeAdapter[BrowserRequest] = TypeAdapter(Annotated[BrowserRequest, Field(discriminator="type")])


class RequestError(Exception):
    """Why a browser's message cannot be read, as text."""


def read_request(text: str) -> BrowserRequest:
    """A browser's message. Raises RequestError."""
    try:
        return _ASKED.validate_json(text, strict=True)
    except ValidationError as error:
        raise RequestError(fault_words(error)) from error


def to_json(kind: str, **content: Any) -> str:
    """A text message; numbers that are not finite become null, which JSON has and NaN it has not."""
    return json.dumps({"type": kind, **_finite(content)}, allow_nan=False, separators=(",", ":"))


def pose_json(pose: Pose) -> str:
    """Base in map. covariance: the 9 values of x, y, theta in base axes; m^2, m rad, rad^2."""
    return to_json("pose", **pose_fields(pose))


def event_fields(events: Sequence[tuple[float, str]]) -> list[dict[str, Any]]:
    """Of events, each Unix time, s, and text."""
    return [{"stamp_s": stamp_s, "text": text} for stamp_s, text in events]


def mountings_json(poses_base_sensor: Mapping[str, SE2]) -> str:
    poses = {sensor: [pose.x_m, pose.y_m, pose.theta_rad] for sensor, pose in poses_base_sensor.items()}
    return to_json("mountings", pose_base_sensor=poses)


def health_json(
    statuses: Sequence[Status], since_s: Mapping[str, float], latency_ms: Mapping[str, float], stamp_s: float
) -> str:
    """since_s: Unix time since when a status is as it is, by its name; latency_ms: by sensor."""
    return to_json(
        "health",
        stamp_s=stamp_s,
        latency_ms=dict(latency_ms),
        statuses=[
            {**status._asdict(), "values": dict(status.values), "since_s": since_s[status.name]}
            for status in statuses
        ],
    )


def series_json(
    rows: Sequence[Row], goes_on: bool = False, events: Sequence[tuple[float, str]] | None = None
) -> str:
    """Figures by name, of each row; null where one is not known.

    goes_on    the rows lie behind those so far
    events     Unix time, s, and text: all that happened; None: they come one by one
    """
    names = sorted({name for row in rows for name in row.figures})
    return to_json(
        "series",
        goes_on=goes_on,
        stamp_s=[round(row.stamp_s, 3) for row in rows],
        state=[row.state for row in rows],
        level=[row.level for row in rows],
        figures={name: [_rounded(row.figures.get(name)) for row in rows] for name in names},
        events=None if events is None else event_fields(events),
    )


def _rounded(value: float | None) -> float | None:
    """To five digits, enough for a plot."""
    return None if value is None else float(f"{value:.5g}")


def encode_tiles(tiles: Sequence[TileUpdate]) -> bytes:
    """Tiles of one size, at least one."""
    first = tiles[0]
    cells = first.cells.shape[0]
    places = np.array([(tile.ix, tile.iy) for tile in tiles], dtype="<i4")
    body = places.tobytes() + b"".join(
        np.ascontiguousarray(tile.cells, dtype=np.int8).tobytes() for tile in tiles
    )
    header = struct.pack("<BBHfI", TILES, 0, cells, first.cell_m, len(tiles))
    return header + zlib.compress(body, DEFLATE_LEVEL)


def encode_scan(scan: LaserScan) -> bytes:
    """Angles count from the sensor's forward axis, counter-clockwise; its mounting is distinguished."""
    name = scan.sensor.encode()
    steps = np.nan_to_num(scan.range_m / np.float32(RANGE_STEP_M), nan=0.0, posinf=0.0, neginf=0.0)
    ranges = np.where(steps < FIRST_CAUSE - 0.5, np.rint(steps), 0.0).astype("<u2")
    causes = causes_of(scan.range_m)
    ranges = np.where(causes > 0, FIRST_CAUSE + causes.astype("<u2"), ranges).astype("<u2")
    header = struct.pack(
        "<BBHdfff",
        SCAN,
        len(name),
        ranges.size,
        scan.stamp_ns / 1e9,
        scan.first_angle_rad,
        scan.angle_step_rad,
        scan.beam_interval_ns * 1e-9,
    )
    return header + name + ranges.tobytes()


def encode_path(points_map: FloatArray, goes_on: bool = False) -> bytes:
    """points_map: (N, 2), m. goes_on: they lie behind the path so far."""
    return struct.pack("<BBHI", PATH, goes_on, 0, len(points_map)) + points_map.astype("<f4").tobytes()


def encode_graph(picture: GraphPicture) -> bytes:
    lines = [*picture.paths, *picture.borders]
    counts = [len(picture.paths), len(picture.borders), len(picture.accepted), len(picture.refused)]
    counts += [len(line) for line in lines]
    parts = [*lines, picture.accepted, picture.refused]
    body = np.array(counts, "<u4").tobytes() + b"".join(part.astype("<f4").tobytes() for part in parts)
    body += json.dumps(picture.evidence, separators=(",", ":")).encode()
    return struct.pack("<BBH", GRAPH, 0, 0) + zlib.compress(body, DEFLATE_LEVEL)


def encode_standing(grid: Grid | None) -> bytes:
    """See service.mapper.maps.occupancy; None: of nothing it is known."""
    return _encode_picture(STANDING, grid)


def encode_changes(grid: Grid | None) -> bytes:
    """See service.mapper.map_changes; None: changes are not watched."""
    return _encode_picture(CHANGED, grid)


def _encode_picture(kind: int, grid: Grid | None) -> bytes:
    if grid is None:
        return struct.pack("<BBHfiiII", kind, 0, 0, 1.0, 0, 0, 0, 0) + zlib.compress(b"")
    height, width = grid.cells.shape
    column, row = round(grid.x_min_m / grid.cell_m), round(grid.y_min_m / grid.cell_m)
    header = struct.pack("<BBHfiiII", kind, 1, 0, grid.cell_m, column, row, width, height)
    return header + zlib.compress(np.ascontiguousarray(grid.cells, np.int8).tobytes(), DEFLATE_LEVEL)


def pose_fields(pose: Pose) -> dict[str, Any]:
    return {
        "stamp_ns": str(pose.stamp_ns),  # too long for a number of JavaScript
        "stamp_s": pose.stamp_ns / 1e9,
        "x_m": pose.pose.x_m,
        "y_m": pose.pose.y_m,
        "theta_rad": pose.pose.theta_rad,
        "covariance": pose.covariance.ravel().tolist(),
        "twist": list(pose.twist),
    }


def _finite(value: Any) -> Any:
    match value:
        case float():
            return value if np.isfinite(value) else None
        case dict():
            return {key: _finite(item) for key, item in value.items()}
        case list() | tuple():
            return [_finite(item) for item in value]
        case _:
            return value
