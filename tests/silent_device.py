"""A fake device with nothing to send."""


class SilentDevice:
    def connected(self, now_ns: int) -> bytes:
        return b""

    def receive_data(self, data: bytes, now_ns: int) -> bytes:
        return b""

    def next_due_ns(self, now_ns: int) -> int | None:
        return None

    def due(self, now_ns: int) -> bytes:
        return b""

    def disconnected(self, now_ns: int) -> None: ...
