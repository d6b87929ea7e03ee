"""The operator's page of what is past: the base of the pages of results, recordings and replays."""

from collections.abc import Mapping

import numpy as np

from service.mapstore.tiles import TileStore
from service.offline.past.driven_moments import DrivenMoments
from service.offline.past.moments import MomentCommands
from service.offline.past.recorded_moments import RecordedMoments
from service.offline.past.shown_tiles import ShownTiles
from service.publishing.commands import Answer
from service.web.access import new_token
from service.web.config import WebConfig
from service.web.protocol import encode_path
from service.web.send_queue import Payload
from service.web.server import About, WebServer


class PastPage:
    """To be served by start_serving; until `close`.

    name      title of what the page shows
    kind      where the page of a running service has its profile
    listen    as web.listen in a config
    """

    moments: MomentCommands | None = None  # None: no moment can be gone to

    def __init__(self, name: str, kind: str, listen: str) -> None:
        self.token = new_token()
        store = TileStore()
        self.tiles = ShownTiles(store)
        self.server = WebServer(
            WebConfig(listen=listen),
            About(name, kind, self.verbs),
            store,
            self.answer,
            self.token,
            retry_s=None,
        )

    @property
    def address(self) -> str:
        """With the token, which commands need."""
        return f"{self.server.address}#token={self.token}"

    def close(self) -> None:
        self.server.close()

    def verbs(self) -> tuple[str, ...]:
        """Commands that can be given now."""
        return () if self.moments is None else self.moments.verbs

    def answer(self, verb: str, payload: bytes) -> Answer:
        """From a thread of the page."""
        assert self.moments is not None
        return self.moments.answer(verb, payload)

    def look_back(self, moments: DrivenMoments | RecordedMoments, at_ns: int | None = None) -> None:
        """Show the complete path and one of its moments, None: the last; from then on any can be gone to.

        Raises InputError where the moment cannot be read.
        """
        self.server.put_ready({"path": encode_path(moments.path_map.astype(np.float32))})
        commands = MomentCommands(moments, self.show_moment)
        commands.go_to(moments.last_ns if at_ns is None else at_ns)
        self.moments = commands

    def show_moment(self, at_ns: int, payloads: Mapping[str, Payload]) -> None:
        self.server.put_ready(payloads)
