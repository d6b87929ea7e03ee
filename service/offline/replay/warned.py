"""The warnings of a replay, for its summary."""

import logging
import threading

from service.timing.words import kind_of

LOGGER = logging.getLogger("service")


class Warned(logging.Handler):
    """Inside of `with`, collects what the service logs as a warning or worse in this thread.

    Lines that differ in their numbers alone are one, in the words of the first.
    """

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self._kinds: dict[str, str] = {}
        self._thread = threading.get_ident()

    def __enter__(self) -> "Warned":
        LOGGER.addHandler(self)
        return self

    def __exit__(self, *exception: object) -> None:
        LOGGER.removeHandler(self)

    @property
    def lines(self) -> list[str]:
        """In the order in which they came."""
        return list(self._kinds.values())

    def emit(self, record: logging.LogRecord) -> None:
        if record.thread == self._thread:
            line = record.getMessage()
            self._kinds.setdefault(kind_of(line), line)
