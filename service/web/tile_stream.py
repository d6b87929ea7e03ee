"""Map tiles newer than a browser's version, encoded once for all browsers that request the same."""

import asyncio
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from service.outputs import TileUpdate
from service.web.protocol import encode_tiles

MAX_CELLS = 2**20  # in one message, 1 MiB before deflating: what a pose may have to wait for
FIRST_CELLS = 2**17  # ... in the first one: the sooner there is something to see
KEPT_BATCHES = 8


class MapSource(Protocol):
    """The tile store as the page reads it."""

    @property
    def version(self) -> int: ...
    @property
    def number(self) -> int: ...
    def since(self, version: int) -> list[TileUpdate]: ...


@dataclass(frozen=True, slots=True)
class Batch:
    payload: bytes
    version: int  # of its newest tile: what the browser has then
    is_last: bool  # the browser then has all there was


class TileFeed:
    """Called from the event loop; deflating is done in a thread, which leaves the interpreter to others."""

    def __init__(self, source: MapSource) -> None:
        self._source = source
        self._lock = asyncio.Lock()
        self._kept: OrderedDict[tuple[int, int], Batch] = OrderedDict()  # by version before and newest then

    async def after(self, version: int) -> Batch | None:
        """The next tiles for a browser that has all up to `version`; None where it has the newest."""
        async with self._lock:  # a second request for the same finds it made
            newest = self._source.version
            if version >= newest:
                return None
            key = (version, newest)
            if (kept := self._kept.get(key)) is not None:
                return kept
            batch = await asyncio.to_thread(self._make, version)
            if batch is not None:
                self._kept[key] = batch
                if len(self._kept) > KEPT_BATCHES:
                    self._kept.popitem(last=False)
            return batch

    def _make(self, version: int) -> Batch | None:
        newer = [tile for tile in self._source.since(version) if tile.level == 0]
        if not newer:
            return None
        count = _batch_size(newer, MAX_CELLS if version else FIRST_CELLS)
        return Batch(encode_tiles(newer[:count]), newer[count - 1].version, count == len(newer))


def _batch_size(tiles: Sequence[TileUpdate], max_cells: int) -> int:
    """How many of the tiles, oldest change first, make a message: of one shape, and no version in two."""
    shape, cell_m = tiles[0].cells.shape, tiles[0].cell_m
    most = max(1, max_cells // tiles[0].cells.size)
    count = 1
    while count < len(tiles) and tiles[count].cells.shape == shape and tiles[count].cell_m == cell_m:
        if count >= most and tiles[count].version != tiles[count - 1].version:
            break
        count += 1
    return count
