"""A recording on the operator's page, at any of its moments: back and forth, nothing is mapped again."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from service.mapstore.tiles import TileStore
from service.offline.past.moments import MomentCommands
from service.offline.past.recorded_moments import RecordedMoments
from service.offline.past.shown_tiles import ShownTiles
from service.web.access import new_token
from service.web.config import WebConfig
from service.web.protocol import encode_path, series_json
from service.web.send_queue import Payload
from service.web.server import About, WebServer, start_serving


class RecordingView:
    """A page that shows a recording until `close`; at first its last moment.

    paths       files of one recording, or a folder of them
    listen      as web.listen in a config
    progress    called with the share of the recording that is read

    Who looks sees the moment that someone with the token has gone to last. Raises InputError where the
    recording holds no poses, StorageError where the page cannot be served.
    """

    def __init__(
        self, paths: Sequence[Path], listen: str, progress: Callable[[float], None] = lambda share: None
    ) -> None:
        self.token = new_token()
        self._moments = moments = RecordedMoments(paths, progress)
        store = TileStore()
        self._tiles = ShownTiles(store)
        commands = MomentCommands(moments, self._show)
        about = About(moments.name, "recorded", lambda: commands.verbs)
        self._server = WebServer(
            WebConfig(listen=listen), about, store, commands.answer, self.token, retry_s=None
        )
        path = encode_path(moments.path_map.astype(np.float32))
        series = series_json(moments.rows, events=moments.events)
        self._server.put_ready({"path": path, "series": series})
        commands.go_to(moments.last_ns)
        start_serving(self._server)

    @property
    def address(self) -> str:
        """With the token, which going to another moment needs."""
        return f"{self._server.address}#token={self.token}"

    def close(self) -> None:
        self._server.close()

    def _show(self, at_ns: int, payloads: Mapping[str, Payload]) -> None:
        self._tiles.take(self._moments.tiles_at(at_ns))
        self._server.put_ready(payloads)
