"""Whether a key has subscribers: expensive messages are made only then."""

from collections.abc import Callable
from typing import Any

import zenoh


class Listeners:
    """Subscribers of one key, by a plain publisher that never puts: an advanced one does not report them.

    appeared   called in Zenoh's thread when there is a subscriber and was none
    """

    def __init__(self, session: zenoh.Session, key: str, appeared: Callable[[], None]) -> None:
        def changed(status: zenoh.MatchingStatus) -> None:
            if status.matching:
                appeared()

        self._publisher = session.declare_publisher(key)
        taken = zenoh.handlers.Callback(changed, indirect=False)
        self._listener = self._publisher.declare_matching_listener(taken)

    @property
    def are_there(self) -> bool:
        status: Any = self._publisher.matching_status  # bool in its stub; it is an object, and always true
        return bool(status.matching)
