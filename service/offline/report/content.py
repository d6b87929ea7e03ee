"""What the folder of a result holds, as far as its report shows it; older ones hold less."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, ValidationError

from service.errors import InputError, fault_words
from service.geometry.geo_reference import GeoReference
from service.geometry.poses import Floats
from service.mapper.saved_graph import SavedGraph
from service.mapstore.picture import Picture
from service.offline.maps.loops import loops_of
from service.offline.past.result import SUMMARY_FILE, TRAJECTORY_FILE, open_result
from service.offline.replay.states_file import STATES_FILE, States, read_states
from service.offline.score.trajectory import Trajectory
from service.readable import refuse_unreadable

AGAIN = "a newer corridor writes it: replay the recording again"


class _Lenient(BaseModel):
    model_config = ConfigDict(frozen=True, extra="ignore", allow_inf_nan=False)


class StateReason(_Lenient):
    reason: str
    scans: int
    first_s: float
    id: str = ""


class SensorFrames(_Lenient):
    """Frames of a sensor, as in service.offline.replay.sensor_rates."""

    frames: int
    rate_hz: float | None = None
    gaps: int = 0
    longest_gaps: list[tuple[float, float]] = []


class Mounting(_Lenient):
    x_m: float
    y_m: float
    yaw_deg: float


class Summary(_Lenient):
    """The shown part of summary.json."""

    corridor: str = ""
    profile: str = ""
    recording: list[str] = []
    scans: int | None = None
    scans_dropped: int = 0
    duration_s: float | None = None
    realtime_factor: float | None = None
    loop_closures: int | None = None
    keyframes: int | None = None
    state: dict[str, int] = {}
    state_reasons: dict[str, list[StateReason]] = {}
    samples_dropped: dict[str, int] = {}
    warnings: list[str] | None = None
    sensors: dict[str, SensorFrames] | None = None
    mountings: dict[str, Mounting] = {}
    mapping: dict[str, Any] | None = None


@dataclass(frozen=True, slots=True)
class Loop:
    """One that was measured; see map_loops.

    back_ns     stamp of its second key frame
    why_not     "" where it holds the graph together
    """

    x_m: float
    y_m: float
    back_ns: int
    off_mm: float
    off_deg: float
    why_not: str


@dataclass(frozen=True, slots=True, eq=False)
class Content:
    """Contents of a report; None: missing in the folder.

    edit       words of the edit that made the newest version of the map; None: the drive made it
    missing    what is not in the folder, and what to do: a line each
    """

    folder: Path
    summary: Summary
    trajectory: Trajectory | None
    states: States | None
    picture: Picture | None
    loops: list[Loop] | None
    geo: GeoReference | None
    edit: str | None
    missing: list[str] = field(default_factory=list)

    @property
    def begin_ns(self) -> int:
        """Stamp of the first scan; 0 where that is unknown."""
        for stamps in (self.states, self.trajectory):
            if stamps is not None and len(stamps.stamp_ns):
                return int(stamps.stamp_ns[0])
        return 0

    @property
    def duration_s(self) -> float:
        for stamps in (self.states, self.trajectory):
            if stamps is not None and len(stamps.stamp_ns):
                return int(stamps.stamp_ns[-1] - stamps.stamp_ns[0]) / 1e9
        return self.summary.duration_s or 0.0


def read_content(folder: Path) -> Content:
    """Content for the newest version of the map. Raises InputError where the folder is no result, or where a
    file of it is damaged.
    """
    refuse_unreadable(folder)
    result = open_result(folder)
    if not result.summary:
        raise InputError(
            f"{folder}: no {SUMMARY_FILE} in it, so it is not the folder of a replay; corridor replay "
            "SESSION.mcap --out DIR writes one"
        )
    summary = _checked(result.summary, folder / SUMMARY_FILE)
    states = read_states(folder / STATES_FILE) if (folder / STATES_FILE).is_file() else None
    stored = result.stored
    graph = None if stored is None else stored.graph
    content = Content(
        folder=folder,
        summary=summary,
        trajectory=result.trajectory if states is None or len(states.stamp_ns) > 1 else None,
        states=states,
        picture=result.picture if result.has_map else None,
        loops=None if graph is None else _loops(graph),
        geo=result.geo,
        edit=stored.edit.words if stored is not None and stored.edit is not None else None,
    )
    return replace(content, missing=list(_missing(content)))


def _missing(content: Content) -> Iterator[str]:
    summary = content.summary
    if content.trajectory is None:
        yield f"path: no {TRAJECTORY_FILE} with 2 poses or more"
    if content.states is None:
        yield f"sigma and states over time: no {STATES_FILE}; {AGAIN}"
    if content.picture is None:
        yield "map: neither map/ nor map.yaml"
    if content.loops is None:
        yield "errors of the loops: no map/ with a graph; not every profile stores one, nor does localisation"
    for what, value in (
        ("rates and gaps of the sensors", summary.sensors),
        ("settings", summary.mapping),
        ("warnings", summary.warnings),
    ):
        if value is None:
            yield f"{what}: not in {SUMMARY_FILE}; {AGAIN}"


def _checked(summary: Mapping[str, Any], path: Path) -> Summary:
    try:
        return Summary.model_validate(summary)
    except ValidationError as error:
        raise InputError(f"{path}: {fault_words(error)}") from error


def _loops(graph: SavedGraph) -> list[Loop]:
    accepted, refused = loops_of(graph)
    return [
        Loop(
            facts["x_m"],
            facts["y_m"],
            int(graph.stamp_ns[facts["keyframes"][1]]),
            facts["off_mm"],
            facts["off_deg"],
            facts.get("why", ""),
        )
        for facts in (*accepted, *refused)
    ]


def path_length_m(poses: Floats) -> float:
    """Length of the path through (N, 3) poses."""
    return float(np.hypot(*np.diff(poses[:, :2], axis=0).T).sum())
