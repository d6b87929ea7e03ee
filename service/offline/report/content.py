"""What the folder of a result holds, as far as its report shows it."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, PositiveInt, ValidationError

from service.errors import InputError, fault_words
from service.geometry.geo_reference import GeoReference
from service.geometry.poses import Floats
from service.mapper.saved_graph import SavedGraph
from service.mapstore.picture import Picture
from service.offline.maps.loops import loops_of
from service.offline.past.result import SUMMARY_FILE, open_result
from service.offline.replay.states_file import STATES_FILE, States, read_states
from service.offline.score.trajectory import Trajectory
from service.readable import refuse_unreadable


class _Facts(BaseModel):
    model_config = ConfigDict(frozen=True, extra="ignore", allow_inf_nan=False)


class StateReason(_Facts):
    id: str
    reason: str


class SensorFrames(_Facts):
    """Frames of a sensor, as in service.offline.replay.figures."""

    frames: int
    rate_hz: float | None
    gaps: int
    longest_gaps: list[tuple[float, float]]


class Mounting(_Facts):
    x_m: float
    y_m: float
    yaw_deg: float


class Summary(_Facts):
    """The shown part of summary.json."""

    corridor: str
    profile: str
    recording: list[str]
    scans: PositiveInt
    scans_dropped: int
    loop_closures: int
    state: dict[str, int]
    state_reasons: dict[str, list[StateReason]]
    warnings: list[str]
    sensors: dict[str, SensorFrames]
    mountings: dict[str, Mounting]
    mapping: dict[str, Any]


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
    """Contents of a report.

    trajectory None of a single scan
    loops      None where the result has no graph
    edit       words of the edit that made the newest version of the map; None: the drive made it
    """

    folder: Path
    summary: Summary
    trajectory: Trajectory | None
    states: States
    picture: Picture
    loops: list[Loop] | None
    geo: GeoReference | None
    edit: str | None

    @property
    def begin_ns(self) -> int:
        """Stamp of the first scan."""
        return int(self.states.stamp_ns[0])

    @property
    def duration_s(self) -> float:
        return int(self.states.stamp_ns[-1] - self.states.stamp_ns[0]) / 1e9


def read_content(folder: Path) -> Content:
    """Content for the newest version of the map. Raises InputError where the folder is no result, or where a
    file of it is damaged or not there.
    """
    refuse_unreadable(folder)
    result = open_result(folder)
    if not result.summary:
        raise InputError(
            f"{folder}: no {SUMMARY_FILE} in it, so it is not the folder of a replay; corridor replay "
            "SESSION.mcap --out DIR writes one"
        )
    summary = _checked(result.summary, folder / SUMMARY_FILE)
    states = read_states(folder / STATES_FILE)
    if not len(states.stamp_ns):
        raise InputError(f"{folder / STATES_FILE}: no scan in it")
    stored = result.stored
    graph = None if stored is None else stored.graph
    return Content(
        folder=folder,
        summary=summary,
        trajectory=result.trajectory if len(states.stamp_ns) > 1 else None,
        states=states,
        picture=result.picture,
        loops=None if graph is None else _loops(graph),
        geo=result.geo,
        edit=stored.edit.words if stored is not None and stored.edit is not None else None,
    )


def _checked(summary: Mapping[str, Any], path: Path) -> Summary:
    try:
        return Summary.model_validate(summary)
    except ValidationError as error:
        raise InputError(f"{path}: {fault_words(error)}; replay the recording again") from error


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
