"""The operator's page of a replay: the map as it grows, and controls for the pace.

It only observes the mapper, so what a replay writes is the same with and without it. Pictures are made in the
thread that maps, ten a second at most.
"""

import logging
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from drivers.counted import counted
from drivers.frames import LaserScan
from service import encoding
from service.errors import InputError
from service.geometry.se2 import SE2
from service.mapper.edit_requests import RequestModel
from service.mapper.map_changes import MapChanges
from service.mapper.mapping_session import MappingSession
from service.offline.maps.requests import Table
from service.offline.past.driven_moments import DrivenMoments, ReplayedMoments
from service.offline.past.moments import GoToRequest
from service.offline.past.past_page import PastPage
from service.offline.replay.pace import Watch
from service.offline.replay.raw import FROM_RAW
from service.outputs import NO_GRAPH, GraphPicture, MapperOutput, TileUpdate
from service.recording.mcap_source import Session
from service.web.protocol import encode_changes, encode_standing, to_json
from service.web.server import start_serving

log = logging.getLogger(__name__)

PICTURE_S = 0.1  # pose and scans
STATUS_S = 0.5
TILES_S = 0.5
MIN_REST = 20.0  # looking at all tiles may take a share of 1 / MIN_REST of the time


class NoRequest(RequestModel):
    """Request of replay_pause and replay_resume."""


class RateRequest(RequestModel):
    """Seconds of the recording a second; 0: as fast as it goes."""

    rate: Annotated[float, Field(ge=0.0, le=10_000.0)]


class ReplayPage(PastPage, Watch):
    """Served from its construction until `close`.

    listen      as web.listen in a config
    name        title of what the page shows
    rate        as of Pace

    Raises StorageError where the page cannot be served.
    """

    what = "this is a replay"

    def __init__(self, listen: str, name: str, rate: float, is_paused: bool = False) -> None:
        Watch.__init__(self, rate, is_paused)
        self._session: Session | None = None
        self._mapper: MappingSession | None = None
        self._changes: MapChanges | None = None  # that are shown
        self._log_ns = 0  # of the step that is taken
        self._output: MapperOutput | None = None  # the newest
        self._scans: dict[str, LaserScan] = {}  # the newest of each laser
        self._graph: GraphPicture | None = None  # the newest that is shown
        self._path: list[tuple[float, float]] = []  # driven since the last picture
        self._stamps: list[tuple[int, int]] = []  # of each scan mapped in the present map: measured, logged
        self._phase = "starting"  # replaying, closing loops, finished
        self._picture_due_s = self._status_due_s = self._tiles_due_s = 0.0
        self._speed_from: tuple[float, int] | None = None  # moment and log time of the last status
        PastPage.__init__(self, name, "", listen)
        start_serving(self.server)

    def commands(self) -> Table:
        acts: dict[str, tuple[type[RequestModel], Callable[[Any], None]]] = {
            "replay_pause": (NoRequest, lambda _: self._pace.pause()),
            "replay_resume": (NoRequest, lambda _: self._pace.resume()),
            "replay_rate": (RateRequest, lambda requested: self._pace.set_rate(requested.rate)),
            "replay_go_to": (GoToRequest, self._go_forward),
        }
        steering = {verb: (kind, partial(self._steer, act)) for verb, (kind, act) in acts.items()}
        return {**steering, **super().commands()}

    def begin(self, session: Session, mapper: MappingSession, poses_base_sensor: Mapping[str, SE2]) -> None:
        self._session, self._mapper = session, mapper
        self._begin_map()
        self._log_ns = session.recording.first_log_ns
        self._phase = "replaying"
        self.server.put(encoding.encode_tf_static(poses_base_sensor, self._log_ns, self._log_ns))
        self._tell_status()

    def wait_for(self, log_ns: int) -> None:
        self._log_ns = log_ns
        self._pace.wait_for(log_ns, self._show_all)

    def mapped(self, scan: LaserScan, output: MapperOutput) -> None:
        if self._phase == "finished":
            self._begin_map()
            self._phase = "replaying"
        self._output, self._scans[scan.sensor] = output, scan
        self._stamps.append((output.stamp_ns, self._log_ns))
        pose = output.pose_map_base
        self._path.append((pose.x_m, pose.y_m))
        now_s = time.monotonic()
        if now_s < self._picture_due_s:
            return
        self._show_picture(now_s)
        if now_s >= self._status_due_s:
            self._tell_status()
        if now_s >= self._tiles_due_s:
            self._show_tiles()

    def closing(self) -> None:
        self._show_all()
        self._phase = "closing loops"
        self._tell_status()

    def finished(self, tiles: Sequence[TileUpdate], poses_map_base: Sequence[SE2]) -> None:
        self.tiles.take(tiles)
        self.server.put_ready({encoding.STANDING: encode_standing(None)})  # reported before the last loops
        self._show_changes(self._mapper.map_changes if self._mapper is not None else None)
        self._show_graph()
        self._path.clear()
        self._phase = "finished"
        self._look_back(poses_map_base)
        self._tell_status()

    def _look_back(self, poses_map_base: Sequence[SE2]) -> None:
        """From now on any moment can be gone to; at first the last is shown."""
        assert self._session is not None
        stamp_ns, log_ns = np.array(self._stamps, np.int64).T
        poses = np.array([(p.x_m, p.y_m, p.theta_rad) for p in poses_map_base])
        is_remade = FROM_RAW in self._session.metadata  # then its file is gone later
        try:
            self.look_back(
                DrivenMoments(stamp_ns, poses)
                if is_remade
                else ReplayedMoments(self._session, stamp_ns, log_ns, poses)
            )
        except InputError as error:
            log.warning("the page cannot look back: %s", error)  # the result is written all the same

    def _begin_map(self) -> None:
        self.moments = None
        self._stamps.clear()
        self.server.put_ready({"moment": to_json("moment_over")})
        self.tiles.take([])
        self._changes = None
        self.server.put_ready(
            {encoding.STANDING: encode_standing(None), encoding.CHANGES: encode_changes(None)}
        )
        self.server.put_path(np.empty((0, 2), np.float32))
        self._path.clear()
        self.server.put(encoding.encode_graph(NO_GRAPH, self._log_ns))
        self._scans.clear()
        self._output = None

    def _show_all(self) -> None:
        """Before it stands still: all that there is up to here."""
        self._show_picture(time.monotonic())
        self._show_tiles()
        self._tell_status()

    def _show_picture(self, now_s: float) -> None:
        self._picture_due_s = now_s + PICTURE_S
        if self._output is None:
            return
        self.server.put_stretch(np.array(self._path, np.float32).reshape(-1, 2))
        self._path.clear()
        for scan in self._scans.values():
            self.server.put(encoding.encode_frame(scan, log_ns=self._log_ns))
        self.server.put(encoding.encode_pose(self._output, self._log_ns))

    def _show_tiles(self) -> None:
        if self._mapper is None or self._output is None:
            return
        began_s = time.monotonic()
        self.tiles.take(self._mapper.tiles())
        self._show_graph()
        self.server.put_ready({encoding.STANDING: encode_standing(self._mapper.standing())})
        self._show_changes(self._mapper.changes_reported)
        now_s = time.monotonic()
        self._tiles_due_s = now_s + max(TILES_S, MIN_REST * (now_s - began_s))

    def _show_changes(self, changes: MapChanges | None) -> None:
        if changes is not None and not changes.has_same_cells(self._changes):
            self._changes = changes
            self.server.put_ready({encoding.CHANGES: encode_changes(changes.as_grid())})

    def _show_graph(self) -> None:
        picture = self._mapper.graph_picture if self._mapper is not None else None
        if picture is not None and picture is not self._graph:
            self._graph = picture
            self.server.put(encoding.encode_graph(picture, self._log_ns))

    def _tell_status(self) -> None:
        assert self._session is not None
        self._status_due_s = time.monotonic() + STATUS_S
        rows = [self._mapping_status(), self._replay_status(self._session)]
        self.server.put(encoding.encode_diagnostics("diagnostics", rows, self._log_ns, self._log_ns))

    def _mapping_status(self) -> encoding.Status:
        counters = {} if self._mapper is None else self._mapper.counters
        values = {
            "state": "waiting",
            "scans": str(counters.get("scans", 0)),
            "loop_closures": str(counters.get("loop_closures", 0)),
        }
        if self._output is None:
            return encoding.Status("mapping", encoding.WARNING, "no scan is mapped yet", values)
        state = self._output.state
        values |= {"state": state, "inlier_ratio": f"{self._output.inlier_ratio:.3f}"}
        if self._phase == "finished":
            words = (
                f"finished: {counted(int(values['scans']), 'scan')} mapped, "
                f"{counted(int(values['loop_closures']), 'loop')} closed"
            )
            return encoding.Status("mapping", encoding.OK, words, values | {"state": "finished"})
        values["reason_id"] = self._output.reason.id
        return encoding.Status(
            "mapping", encoding.LEVEL_OF_STATE[state], self._output.reason or state, values
        )

    def _replay_status(self, session: Session) -> encoding.Status:
        recording, pace = session.recording, self._pace
        state = self._phase
        if state == "replaying" and pace.is_paused:
            state = "paused"
        values = {
            "state": state,
            "recording": Path(recording.paths[0]).name,
            "position_s": f"{self._position_s():.2f}",
            "duration_s": f"{(recording.last_log_ns - recording.first_log_ns) / 1e9:.2f}",
            "rate": f"{pace.rate:g}",
            "speed": f"{self._speed():.1f}",
        }
        return encoding.Status("replay", encoding.OK, state, values)

    def _speed(self) -> float:
        """Seconds of the recording a second, since the last status."""
        now = time.monotonic(), self._log_ns
        before, self._speed_from = self._speed_from or now, now
        return (now[1] - before[1]) / 1e9 / max(now[0] - before[0], 1e-3)

    def _position_s(self) -> float:
        first_ns = self._log_ns if self._session is None else self._session.recording.first_log_ns
        return max(self._log_ns - first_ns, 0) / 1e9

    def _steer(self, act: Callable[[Any], None], requested: RequestModel) -> dict[str, Any]:
        if self._session is None or self._phase in ("closing loops", "finished"):
            raise InputError(f"the replay is {self._phase}")
        act(requested)
        return {"position_s": round(self._position_s(), 3)}

    def _go_forward(self, requested: GoToRequest) -> None:
        assert self._session is not None
        if requested.position_s < (now_s := self._position_s()):
            raise InputError(
                f"the replay is at {now_s:.1f} s and goes forward only; replay the recording again "
                "to see what was before"
            )
        self._pace.go_to(self._session.recording.first_log_ns + round(requested.position_s * 1e9))
