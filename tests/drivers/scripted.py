"""A transport that follows a script."""

from collections.abc import Sequence

from drivers.errors import TransportError
from drivers.transport import Transport


class ScriptedTransport(Transport):
    """Returns the given chunks, one a read, keeps what is written, and then raises TransportError."""

    def __init__(self, chunks: Sequence[bytes]) -> None:
        self._chunks = list(chunks)
        self.written = bytearray()
        self.closed = False

    def read(self, timeout_s: float) -> bytes:
        if not self._chunks:
            raise TransportError("script ended")
        return self._chunks.pop(0)

    def write(self, data: bytes) -> None:
        self.written += data

    def close(self) -> None:
        self.closed = True
