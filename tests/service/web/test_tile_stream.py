import asyncio
import struct

from service.mapstore.tiles import TileStore
from service.web import tile_stream
from service.web.tile_stream import TileFeed
from tests.service.mapstore.tile_makers import EDGE, tile


def count_of(payload: bytes) -> int:
    return struct.unpack_from("<I", payload, 8)[0]


def test_a_large_map_comes_in_parts_between_versions(monkeypatch):
    monkeypatch.setattr(tile_stream, "FIRST_CELLS", EDGE**2)
    monkeypatch.setattr(tile_stream, "MAX_CELLS", 2 * EDGE**2)
    store = TileStore()
    store.update([tile(ix, 0, version) for ix, version in enumerate((1, 2, 2, 3, 4))])

    async def ask():
        feed, version, counts = TileFeed(store), 0, []
        while (batch := await feed.after(version)) is not None:
            counts.append(count_of(batch.payload))
            version = batch.version
        return counts

    assert asyncio.run(ask()) == [1, 2, 2]  # two of version 2 stay together


def test_coarser_levels_are_not_sent():
    store = TileStore()
    store.update([tile(0, 0, 1), tile(0, 0, 2, level=1)])

    async def ask():
        feed = TileFeed(store)
        batch = await feed.after(0)
        assert count_of(batch.payload) == 1
        assert await feed.after(batch.version) is None

    asyncio.run(ask())
