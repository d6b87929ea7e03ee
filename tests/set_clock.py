"""A clock that a test sets."""


class SetClock:
    """In place of `time.monotonic` or `time.time`: it wakes no one, who waits for it looks at it."""

    def __init__(self, now_s: float = 100.0) -> None:
        self.now_s = now_s

    def __call__(self) -> float:
        return self.now_s
