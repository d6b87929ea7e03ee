"""The operator's page of what is past: what all such pages share, and that of a recording."""

import json
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from service.errors import CorridorError
from service.mapstore.tiles import TileKey, TileStore
from service.offline.maps.requests import Table, carry_out
from service.offline.past.driven_moments import DrivenMoments
from service.offline.past.moments import GO_TO, GoToRequest, payloads_of
from service.offline.past.recorded_moments import RecordedMoments
from service.outputs import UNKNOWN, TileUpdate
from service.publishing.commands import Answer, refusal
from service.web.access import new_token
from service.web.config import WebConfig
from service.web.protocol import encode_path, series_json
from service.web.send_queue import Payload
from service.web.server import About, WebServer, start_serving

Moments = DrivenMoments | RecordedMoments


class ShownTiles:
    """Hands on to a store what differs from what it has; one thread."""

    def __init__(self, store: TileStore) -> None:
        self._store = store
        self._shown: dict[TileKey, TileUpdate] = {}

    def take(self, tiles: Sequence[TileUpdate]) -> None:
        """All tiles of the map as it is now; one that is not there any more becomes unknown."""
        present = {(tile.level, tile.ix, tile.iy): tile for tile in tiles}
        changed = [tile for key, tile in present.items() if not _is_same(self._shown.get(key), tile)]
        changed += [
            replace(tile, cells=np.full_like(tile.cells, UNKNOWN))
            for key, tile in self._shown.items()
            if key not in present
        ]
        first = self._store.version + 1
        self._store.update(replace(tile, version=version) for version, tile in enumerate(changed, first))
        self._shown = present


def _is_same(shown: TileUpdate | None, tile: TileUpdate) -> bool:
    return shown is not None and np.array_equal(shown.cells, tile.cells)


class PastPage:
    """To be served by start_serving; until `close`.

    name      title of what the page shows
    kind      where the page of a running service has its profile
    listen    as web.listen in a config
    """

    what = "this is a recording"  # in the answer to a command that there is not
    moments: Moments | None = None  # None: no moment can be gone to

    def __init__(self, name: str, kind: str, listen: str) -> None:
        self.token = new_token()
        self._going = threading.Lock()
        store = TileStore()
        self.tiles = ShownTiles(store)
        about = About(name, kind, lambda: tuple(self.commands()))
        self.server = WebServer(WebConfig(listen=listen), about, store, self.answer, self.token, retry_s=None)

    @property
    def address(self) -> str:
        """With the token, which commands need."""
        return f"{self.server.address}#token={self.token}"

    def close(self) -> None:
        self.server.close()

    def commands(self) -> Table:
        """That can be given now."""
        return {} if self.moments is None else {GO_TO: (GoToRequest, partial(self._go_to, self.moments))}

    def answer(self, verb: str, payload: bytes) -> Answer:
        """JSON in, JSON out, from any thread; what cannot be done is answered with the reason."""
        try:
            facts = carry_out(self.commands(), verb, payload, self.what)
        except CorridorError as error:
            return refusal(str(error))
        return Answer(True, json.dumps({"ok": True, **facts}).encode())

    def look_back(self, moments: Moments, at_ns: int | None = None) -> None:
        """Show the complete path and one of its moments, None: the last; from then on any can be gone to.

        Raises InputError where the moment cannot be read.
        """
        self.server.put_ready({"path": encode_path(moments.path_map.astype(np.float32))})
        self._show_past(moments, moments.last_ns if at_ns is None else at_ns)
        self.moments = moments

    def show_moment(self, at_ns: int, payloads: Mapping[str, Payload]) -> None:
        self.server.put_ready(payloads)

    def _go_to(self, moments: Moments, requested: GoToRequest) -> dict[str, object]:
        self._show_past(moments, moments.first_ns + round(requested.position_s * 1e9))
        return {}

    def _show_past(self, moments: Moments, at_ns: int) -> None:
        """This moment; before the first and behind the last that one."""
        with self._going:
            moment = moments.at(min(max(at_ns, moments.first_ns), moments.last_ns))
            self.show_moment(moment.at_ns, payloads_of(moment, moments.first_ns, moments.last_ns))


class RecordingView(PastPage):
    """A page that shows a recording until `close`; at first its last moment. Nothing is mapped again.

    paths       files of one recording, or a folder of them
    listen      as web.listen in a config
    progress    called with the share of the recording that is read

    Who looks sees the moment that someone with the token has gone to last. Raises InputError where the
    recording holds no poses, StorageError where the page cannot be served.
    """

    def __init__(
        self, paths: Sequence[Path], listen: str, progress: Callable[[float], None] = lambda share: None
    ) -> None:
        self._recorded = recorded = RecordedMoments(paths, progress)
        super().__init__(recorded.name, "recorded", listen)
        self.server.put_ready({"series": series_json(recorded.rows, events=recorded.events)})
        self.look_back(recorded)
        start_serving(self.server)

    def show_moment(self, at_ns: int, payloads: Mapping[str, Payload]) -> None:
        self.tiles.take(self._recorded.tiles_at(at_ns))
        super().show_moment(at_ns, payloads)
