"""The commands of a service. All pass through the intake, so their position among the frames is exact."""

import json
import re
import threading
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from service.encoding import Message, decode_event
from service.encoding.steps import decode_step
from service.errors import StorageError
from service.mapper.edit_requests import Who
from service.mapper.mapping_session import GraphRequest, LoadMap, SessionAction
from service.publishing.commands import CommandError, Outcome, Request, Verb
from service.recording.session_change import SessionChange
from service.runtime.intake import Intake
from service.runtime.mapper_messages import Answer
from service.runtime.mapping_outputs import MappingOutputs
from service.runtime.profile_switch import ProfileSwitch, new_map
from service.sinks.sink import MapStorage, SavedMap, SessionRecorder

FURTHEST_M = 100_000.0  # from the origin of the map, as in an edit of one
_MAP_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,99}")

MapMetres = Annotated[float, Field(ge=-FURTHEST_M, le=FURTHEST_M, allow_inf_nan=False)]


class MarkRequest(Request):
    text: Annotated[str, Field(min_length=1, max_length=1000)]


class PointOfSubmap(BaseModel):
    """A point of the shown map, and the sub-map that drew it; a graph that knows landmarks reads the same."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    submap: Annotated[int, Field(ge=0)]
    x_m: MapMetres
    y_m: MapMetres


class PairRequest(Request):
    first: PointOfSubmap
    second: PointOfSubmap


class PairNumberRequest(Request):
    pair: Annotated[int, Field(ge=0)]


class EditRequest(Request):
    """who: for the recording; change: what the graph of the profile takes, see edit_requests.py"""

    who: Who = ""
    change: dict[str, Any]


class ModeRequest(Request):
    mode: Literal["mapping", "localization"]


class PoseRequest(Request):
    """Pose of the base in the map, set by the operator."""

    x_m: MapMetres
    y_m: MapMetres
    theta_rad: Annotated[float, Field(allow_inf_nan=False)]


def _check_map_name(name: str) -> str:
    if _MAP_NAME.fullmatch(name) is None:
        raise ValueError("takes letters, digits, _ . and -, a letter, digit or _ first, at most 100 of them")
    return name


def _check_folder_name(name: str) -> str:
    if "\0" in name:
        raise ValueError("holds a NUL, which no path does")
    if "/" in name or name in (".", ".."):
        raise ValueError("is a path; write the name of a folder in map.directory, without a slash")
    return name


class SaveRequest(Request):
    """name: of a folder in map.directory, in which the map is stored besides."""

    name: Annotated[str, AfterValidator(_check_map_name)] | None = None


class MapRequest(Request):
    """A stored map: the name of its folder in map.directory; version: left out, the current one."""

    map: Annotated[str, Field(min_length=1, max_length=4096), AfterValidator(_check_folder_name)]
    version: Annotated[int, Field(ge=1)] | None = None


GRAPH_REQUESTS: dict[str, type[Request]] = {  # of the graph of the profile that maps, by verb
    "add_landmark_pair": PairRequest,
    "remove_landmark_pair": PairNumberRequest,
    "set_pose": PoseRequest,
    "edit_map": EditRequest,
    "set_mode": ModeRequest,
    **dict.fromkeys(("checkpoint", "optimize", "undo"), Request),
}

# name, version -> folder, version that can be begun in
FindMap = Callable[[str, int | None], tuple[Path, int]]


# Runs between two frames; never blocks and raises nothing.
CarryOut = Callable[[Message, Outcome], None]


class Commands:
    """Verbs for a CommandDispatcher. The receiver settles the outcome when it is done.

    put        takes a message for all sinks, and only queues it
    recorder   for start_recording and stop_recording
    storage    for save_map, load_map and reset_map
    find_map   of load_map; raises CommandError where no session can begin there
    switch     of switch_profile
    """

    def __init__(
        self,
        intake: Intake,
        outputs: MappingOutputs,
        put: Callable[[Message], Any],
        recorder: SessionRecorder,
        storage: MapStorage,
        find_map: FindMap,
        switch: ProfileSwitch,
    ) -> None:
        self._intake = intake
        self._outputs = outputs
        self._put = put
        self._recorder = recorder
        self._storage = storage
        self._find_map = find_map
        self._lock = threading.Lock()  # of the outcomes that are open
        self._open: list[Outcome] = []
        self._switch = switch
        self._loading = threading.Lock()  # locked while a stored map is read and taken: one after the other

    def verbs(self) -> dict[str, Verb]:
        return {
            "pause": self._verb("pause", partial(self._request_session, "pause")),
            "resume": self._verb("resume", partial(self._request_session, "resume")),
            "reset_map": Verb(Request, self._begin_reset),
            "save_map": self._verb("save_map", self._save_map, SaveRequest),
            "load_map": self._load_verb(),
            "switch_profile": self._switch.verb(self._keep),
            "start_recording": self._verb("start_recording", self._start_recording),
            "stop_recording": self._verb("stop_recording", self._stop_recording),
            "mark": self._verb("mark", self._mark, MarkRequest),
            **{
                name: self._verb(name, partial(self._ask_graph, name), request)
                for name, request in GRAPH_REQUESTS.items()
            },
        }

    def close(self) -> None:
        """Fail the open commands: the service ends."""
        with self._lock:
            for outcome in self._open:
                outcome.failed("the service is stopping")

    def _verb(self, name: str, carry_out: CarryOut, request: type[Request] = Request) -> Verb:
        def start(request: Request, outcome: Outcome) -> None:
            self._keep(outcome)
            if refused := self._mark_in_line(name, request, carry_out, outcome):
                outcome.failed(refused)
                raise CommandError(refused)

        return Verb(request, start)

    def _mark_in_line(self, name: str, request: Request, carry_out: CarryOut, outcome: Outcome) -> str:
        """Execute it between two frames. Returns why that is not possible, "" if it is."""
        event = {"event": name, **request.model_dump(exclude_none=True)}
        return self._intake.mark(event, lambda message: carry_out(message, outcome))

    def _keep(self, outcome: Outcome) -> None:
        with self._lock:
            self._open = [*(o for o in self._open if not o.settled), outcome]

    def _ask_graph(self, name: str, event: Message, outcome: Outcome) -> None:
        """Recorded even if it is refused: a replay refuses it at the same place."""
        self._put(event)
        request = decode_step(event.payload, event.log_ns)
        assert isinstance(request, GraphRequest)

        def answered(answer: Answer) -> None:
            if answer.error:
                outcome.failed(answer.error)
            else:
                outcome.done(**answer.result)

        self._intake.request_graph(name, request.payload, event.log_ns, answered)

    def _request_session(self, action: SessionAction, event: Message, outcome: Outcome) -> None:
        self._put(event)
        self._intake.request_session(action, event.log_ns, lambda answer: outcome.done(changed=answer.result))

    def _begin_reset(self, request: Request, outcome: Outcome) -> None:
        """The map before ends with its graph as it is now: a session can go on in it."""
        self._keep(outcome)

        def reset() -> None:
            if refused := self._mark_in_line("reset_map", request, self._reset_map, outcome):
                outcome.failed(refused)

        self._put_graph_away(reset, outcome.failed)

    def _put_graph_away(self, then: Callable[[], None], refused: Callable[[str], None]) -> None:
        """Before the present map ends: whether it has a graph is seen by its tiles, so these come first."""

        def put_away() -> None:
            try:
                self._storage.put_graph_away(then)
            except StorageError as error:
                refused(f"the present map stays: {error}")

        if why := self._intake.hand_over_tiles(put_away):
            refused(why)

    def _reset_map(self, event: Message, outcome: Outcome) -> None:
        self._put(event)

        def answered(answer: Answer) -> None:
            new_map(outcome, self._outputs, self._storage, self._storage.begun_new, "the map is reset")

        self._intake.request_session("reset_map", event.log_ns, answered)

    def _load_verb(self) -> Verb:
        """Records the folder and the version that the session begins in.

        The map before ends with its graph as it is now.
        """

        def start(request: MapRequest, outcome: Outcome) -> None:
            with self._loading:
                folder, version = self._find_map(request.map, request.version)
                try:
                    self._storage.hold(folder, version)
                except StorageError as error:
                    raise CommandError(str(error)) from error
            self._keep(outcome)
            found = request.model_copy(update={"map": str(folder), "version": version})

            def load() -> None:
                if refused := self._mark_in_line("load_map", found, self._load_map, outcome):
                    self._storage.let_go(folder)
                    outcome.failed(refused)

            def refused(why: str) -> None:
                self._storage.let_go(folder)
                outcome.failed(why)

            self._put_graph_away(load, refused)

        return Verb(MapRequest, start)

    def _load_map(self, event: Message, outcome: Outcome) -> None:
        self._put(event)
        step = decode_step(event.payload, event.log_ns)
        assert isinstance(step, LoadMap)
        folder = Path(step.folder)

        def answered(answer: Answer) -> None:
            if answer.error:
                self._storage.let_go(folder)
                outcome.failed(f"the map before stays: {answer.error}")
                return
            begun, facts = partial(self._storage.begun_in, folder), {"version": step.version}
            new_map(outcome, self._outputs, self._storage, begun, "the map is loaded", **facts)

        self._intake.request_map(step.folder, step.version, event.log_ns, answered)

    def _save_map(self, event: Message, outcome: Outcome) -> None:
        self._put(event)

        def saved(present: SavedMap | None, fault: str) -> None:
            if fault:
                outcome.failed(fault)
            elif present is None:
                outcome.failed("there is no map yet; it begins with the first scan that is mapped")
            else:
                outcome.done(folder=str(present.folder), version=present.number, map_version=present.version)

        name = str(json.loads(decode_event(event.payload)).get("name", ""))
        self._intake.request_tiles(
            event.log_ns, lambda answer: self._storage.ask_to_save(saved, name, with_graph=True)
        )

    def _start_recording(self, event: Message, outcome: Outcome) -> None:
        self._recorder.begin_session(event, partial(self._recording_changed, outcome))

    def _stop_recording(self, event: Message, outcome: Outcome) -> None:
        self._put(event)
        self._recorder.end_session(partial(self._recording_changed, outcome))

    def _recording_changed(self, outcome: Outcome, change: SessionChange) -> None:
        if change.error:
            outcome.failed(change.error)
        else:
            outcome.done(changed=change.changed, files=[str(path) for path in change.files])

    def _mark(self, event: Message, outcome: Outcome) -> None:
        if why := self._recorder.why_not_recording:
            outcome.failed(f"the mark would be lost: {why}")
            return
        self._put(event)
        outcome.done(log_ns=event.log_ns)
