"""Services of ROS 2 as commands: Trigger for pause, resume, save and reset, nav2's LoadMap and SaveMap."""

import json
import logging
import threading
from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import zenoh

from drivers.rmw_zenoh import Attachment
from service.encoding import OCCUPANCY_GRID, Message, encode_grid, read
from service.encoding.ros_services import (
    LOAD_MAP,
    MAP_DOES_NOT_EXIST,
    SAVE_MAP,
    SUCCESS,
    TRIGGER,
    UNDEFINED_FAILURE,
    encode_response,
    read_request,
)
from service.errors import InputError
from service.outputs import Grid
from service.publishing.commands import Answer, CommandError
from service.publishing.query_workers import QueryWorkers
from service.publishing.ros2_node import Ros2Node, reply, request_of

log = logging.getLogger(__name__)

TRIGGERS = {"pause": "pause", "resume": "resume", "save": "save_map", "reset": "reset_map"}  # service -> verb
Command = Callable[[str, bytes], Answer]


_Respond = Callable[[bytes], bytes]  # request -> response. Raises InputError, CommandError
_Refuse = Callable[[str], bytes]  # why it is not done -> response


class Ros2Services:
    """Open when constructed, below the node's name; `command` takes verb and JSON, and may wait."""

    def __init__(
        self,
        node: Ros2Node,
        command: Command,
        present_map: Callable[[], Message | None],
        map_folder: Path | None,
    ) -> None:
        self._node = node
        self._command = command
        self._present_map = present_map
        self._map_folder = map_folder
        self._workers = QueryWorkers("ros2")
        self._lock = threading.Lock()
        self._counts: Counter[str] = Counter()
        for name, verb in TRIGGERS.items():
            self._offer(name, TRIGGER, partial(self._trigger, verb), _not_triggered)
        # The responses of nav2 have no text: the log has the reason.
        self._offer("load_map", LOAD_MAP, self._load_map, lambda _: _map_response(None, UNDEFINED_FAILURE))
        self._offer("save_map", SAVE_MAP, self._save_map, lambda _: encode_response(SAVE_MAP, result=False))

    def counts(self) -> Counter[str]:
        """Requests answered, by service, and "refused": those that were refused or failed."""
        with self._lock:
            return Counter(self._counts)

    def close(self) -> None:
        """Take no more, and let those be answered that were taken."""
        self._node.take_no_more_requests()
        self._workers.close()

    def _offer(self, name: str, service_type: str, respond: _Respond, refuse: _Refuse) -> None:
        self._node.service(name, service_type, partial(self._take, name, respond, refuse))

    def _take(self, name: str, respond: _Respond, refuse: _Refuse, query: zenoh.Query) -> None:
        """Hand the query on; the next waits until it is."""
        try:
            request = request_of(query)
        except ValueError as error:  # its client could not take a response
            self._count("refused")
            log.warning("ros2 service %s: %s", name, error)
            with query:
                query.reply_err(str(error).encode())
            return
        work = partial(self._answer, name, respond, refuse, query, request)
        if refused := self._workers.start(name, work):
            self._reply(name, query, request, self._refusal(name, refuse, refused))

    def _answer(
        self, name: str, respond: _Respond, refuse: _Refuse, query: zenoh.Query, request: Attachment
    ) -> None:
        try:
            response = respond(query.payload.to_bytes() if query.payload is not None else b"")
        except (InputError, CommandError) as error:
            response = self._refusal(name, refuse, str(error))
        except Exception as error:  # no input from outside may end the service
            log.exception("ros2 service %s failed", name)
            response = self._refusal(name, refuse, f"{error!r}; the service's log says more")
        self._reply(name, query, request, response)

    def _reply(self, name: str, query: zenoh.Query, request: Attachment, response: bytes) -> None:
        with query:  # without it the asker would wait until its timeout
            try:
                reply(query, request, response)
            except zenoh.ZError as error:
                log.error("ros2 service %s was answered, but the reply was not delivered: %s", name, error)
            else:
                self._count(name)

    def _refusal(self, name: str, refuse: _Refuse, why: str) -> bytes:
        self._count("refused")
        log.warning("ros2 service %s: %s", name, why)
        return refuse(why)

    def _count(self, what: str) -> None:
        with self._lock:
            self._counts[what] += 1

    def _trigger(self, verb: str, request: bytes) -> bytes:
        """The request is empty; its one byte stands there because a structure needs a member."""
        answer = self._command(verb, b"")
        if not answer.ok:
            raise CommandError(_error(answer))
        return encode_response(TRIGGER, success=True, message=answer.body.decode())

    def _load_map(self, payload: bytes) -> bytes:
        name = self._map_named(read_request(LOAD_MAP, payload).map_url)
        answer = self._command("load_map", json.dumps({"map": name}).encode())
        if answer.ok:
            return _map_response(self._present_map(), SUCCESS)
        is_name = "/" not in name  # of another path it is not revealed whether it is there
        is_there = is_name and self._map_folder is not None and (self._map_folder / name).exists()
        result = UNDEFINED_FAILURE if is_there else MAP_DOES_NOT_EXIST
        return self._refusal("load_map", lambda _: _map_response(None, result), _error(answer))

    def _save_map(self, payload: bytes) -> bytes:
        request = read_request(SAVE_MAP, payload)
        if request.image_format not in ("", "pgm") or request.map_mode not in ("", "trinary"):
            raise InputError(
                f"a map of format {request.image_format!r} and mode {request.map_mode!r}; maps are stored as "
                "'pgm' and 'trinary', and corridor export makes other formats of them"
            )
        name = self._map_named(request.map_url)
        answer = self._command("save_map", json.dumps({"name": name} if name else {}).encode())
        if not answer.ok:
            raise CommandError(_error(answer))
        return encode_response(SAVE_MAP, result=True)

    def _map_named(self, url: str) -> str:
        """A stored map as the commands name it; the path of one in map.directory counts as its name.

        Raises InputError.
        """
        scheme, separator, rest = url.rpartition("://")
        if separator and scheme != "file":
            raise InputError(
                f"map_url {url!r}: expected a name, or file:// and the path of a map in map.directory"
            )
        path = Path(rest).parent if Path(rest).name == "map.yaml" else Path(rest)
        return path.name if separator and path.parent == self._map_folder else rest


def _error(answer: Answer) -> str:
    """Error of a command that failed."""
    return str(json.loads(answer.body)["error"])


def _not_triggered(why: str) -> bytes:
    return encode_response(TRIGGER, success=False, message=why)


def _map_response(present: Message | None, result: int) -> bytes:
    """To load_map; without a map an empty one."""
    grid = present or encode_grid(Grid(0, 1.0, 0.0, 0.0, np.empty((0, 0), np.int8)), 0, 0)
    return encode_response(LOAD_MAP, map=read(OCCUPANCY_GRID, grid.payload), result=result)
