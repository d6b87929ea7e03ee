"""A recording on the operator's page, at any of its moments: back and forth, nothing is mapped again."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from service.offline.past.past_page import PastPage
from service.offline.past.recorded_moments import RecordedMoments
from service.web.protocol import series_json
from service.web.send_queue import Payload
from service.web.server import start_serving


class RecordingView(PastPage):
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
        self._recorded = recorded = RecordedMoments(paths, progress)
        super().__init__(recorded.name, "recorded", listen)
        self.server.put_ready({"series": series_json(recorded.rows, events=recorded.events)})
        self.look_back(recorded)
        start_serving(self.server)

    def show_moment(self, at_ns: int, payloads: Mapping[str, Payload]) -> None:
        self.tiles.take(self._recorded.tiles_at(at_ns))
        super().show_moment(at_ns, payloads)
