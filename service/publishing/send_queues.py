"""Messages that wait to be sent, in two queues, so that a large map never delays a pose.

`StreamQueue` keeps order and lets the oldest go when full; `BulkQueue` keeps only the newest of each thing.
"""

import threading
import time
from collections import Counter, deque
from collections.abc import Iterable
from dataclasses import dataclass

from service.encoding import Message
from service.outputs import TileUpdate

BATCH_S = 0.01  # messages of the stream go out so often: each wake-up of a thread takes processor from a scan


@dataclass(frozen=True, slots=True, eq=False)
class Sending:
    message: Message
    origin_ns: int | None  # host monotonic time from which its latency counts


class StreamQueue:
    """Any thread puts and never waits; one thread takes, a batch each batch_s."""

    def __init__(self, capacity: int, batch_s: float = BATCH_S) -> None:
        self._capacity = capacity
        self._batch_s = batch_s
        self._wake = threading.Condition()
        self._waiting: deque[Sending] = deque()
        self._is_idle = False  # the taker waits for a first message
        self._closed = False
        self._dropped: Counter[str] = Counter()

    def put(self, sending: Sending) -> None:
        with self._wake:
            if self._closed:
                self._dropped[sending.message.channel] += 1
                return
            if len(self._waiting) >= self._capacity:
                self._dropped[self._waiting.popleft().message.channel] += 1
            self._waiting.append(sending)
            if self._is_idle:
                self._wake.notify()

    def take(self) -> list[Sending]:
        """All that wait, oldest first; waits for one, and batch_s. Empty when closed and nothing is left."""
        with self._wake:
            self._wake.wait_for(lambda: self._closed, self._batch_s)
            self._is_idle = True
            self._wake.wait_for(lambda: self._waiting or self._closed)
            self._is_idle = False
            batch, self._waiting = list(self._waiting), deque()
            return batch

    def close(self) -> None:
        with self._wake:
            self._closed = True
            self._wake.notify_all()

    def dropped(self) -> Counter[str]:
        """Messages lost so far, by channel."""
        with self._wake:
            return Counter(self._dropped)


TileKey = tuple[int, int, int]


@dataclass(frozen=True, slots=True, eq=False)
class Bulk:
    """Messages that are due now."""

    messages: list[Message]
    tiles: list[TileUpdate]
    pictures: set[str]  # channels of which a new complete map should be made


class BulkQueue:
    """Messages at once, tiles and pictures of the complete map at most once a period each."""

    def __init__(self, tile_period_s: float, picture_period_s: float) -> None:
        self._tile_period_s, self._picture_period_s = tile_period_s, picture_period_s
        self._wake = threading.Condition()
        self._messages: dict[str, Message] = {}
        self._tiles: dict[TileKey, TileUpdate] = {}
        self._pictures: set[str] = set()
        self._tiles_at_s = self._pictures_at_s = 0.0
        self._closed = False

    def put(self, message: Message) -> None:
        with self._wake:
            self._messages[message.channel] = message
            self._wake.notify()

    def put_tiles(self, tiles: Iterable[TileUpdate]) -> None:
        with self._wake:
            for tile in tiles:
                self._tiles[tile.level, tile.ix, tile.iy] = tile
            self._wake.notify()

    def ask_for(self, *pictures: str) -> None:
        with self._wake:
            self._pictures.update(pictures)
            self._wake.notify()

    def take(self) -> Bulk | None:
        """Messages that are due; waits for some. When closed: all that is left, then None."""
        with self._wake:
            while True:
                now_s = time.monotonic()
                tiles_due = bool(self._tiles) and (self._closed or now_s >= self._tiles_at_s)
                pictures_due = bool(self._pictures) and (self._closed or now_s >= self._pictures_at_s)
                if self._messages or tiles_due or pictures_due:
                    return self._take(now_s, tiles_due, pictures_due)
                if self._closed:
                    return None
                self._wake.wait(self._longest_wait_s(now_s))

    def close(self) -> None:
        with self._wake:
            self._closed = True
            self._wake.notify_all()

    def _take(self, now_s: float, tiles_due: bool, pictures_due: bool) -> Bulk:
        messages, self._messages = list(self._messages.values()), {}
        tiles: list[TileUpdate] = []
        pictures: set[str] = set()
        if tiles_due:
            tiles, self._tiles = list(self._tiles.values()), {}
            self._tiles_at_s = now_s + self._tile_period_s
        if pictures_due:
            pictures, self._pictures = self._pictures, set()
            self._pictures_at_s = now_s + self._picture_period_s
        return Bulk(messages, tiles, pictures)

    def _longest_wait_s(self, now_s: float) -> float | None:
        due_s = [self._tiles_at_s] if self._tiles else []
        if self._pictures:
            due_s.append(self._pictures_at_s)
        return min(due_s) - now_s if due_s else None
