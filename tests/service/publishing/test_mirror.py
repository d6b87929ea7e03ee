"""mirror.py, the program that docs/subscribing.md offers."""

import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack

import numpy as np
import pytest

from drivers.rmw_zenoh import Attachment
from service.mapstore.tiles import TileStore
from tests.in_background import in_background
from tests.service.mapstore.tile_makers import tile
from tests.service.publishing.mirror import MapMirror, connect, follow
from tests.waiting import wait_until


@pytest.fixture
def mapping(publisher, store) -> Iterator[object]:
    """Changes the map 200 times a second; finish() lets it change 50 times more, gives its last version."""
    version, last = 0, sys.maxsize

    def drive(stop: threading.Event) -> None:
        nonlocal version
        random = np.random.default_rng(5)
        while version < last and not stop.wait(0.005):
            version += 1
            changed = [tile(*random.integers(-4, 5, 2).tolist(), version)]
            store.update(changed)
            publisher.map_changed(changed, version, version)

    def finish() -> int:
        nonlocal last
        last = version + 50
        wait_until(lambda: version == last)
        return last

    with in_background(drive):
        yield finish


def tiles_in(store: TileStore) -> dict[str, tuple[int, bytes]]:
    return {f"{t.level}/{t.ix}/{t.iy}": (t.version, t.cells.tobytes()) for t in store.since(0)}


def tiles_of(mirror: MapMirror) -> dict[str, tuple[int, bytes]]:
    return {
        key.split("/tile/")[1]: (version, mirror.cells(key).tobytes())
        for key, (version, _) in mirror.tiles.items()
    }


def newest(mirror: MapMirror) -> int:
    return max(version for version, _ in list(mirror.tiles.values()))


def test_whoever_joins_while_the_map_changes_ends_with_the_same_map(publisher, mapping, store):
    with ExitStack() as opened:
        joined = []
        for _ in range(3):  # one after the other, so that each joins another state
            session, mirror = opened.enter_context(connect(publisher.endpoints[0])), MapMirror()
            subscriber, fetch = follow(session, "veh1", mirror)
            fetch()
            joined.append((mirror, fetch, subscriber, mirror.complete_to))
        last = mapping()
        for mirror, fetch, _, _ in joined:
            wait_until(lambda heard=mirror: newest(heard) == last)  # not asked for
            fetch()
            assert mirror.complete_to == last
            assert tiles_of(mirror) == tiles_in(store)
        joined_at = [version for *_, version in joined]
        assert joined_at == sorted(joined_at)
        assert joined_at[-1] < last


def test_the_mirror_forgets_a_former_run():
    before, after = (
        Attachment(version, 0, bytes([run] * 16)).encode() for version, run in ((900, 1), (3, 2))
    )
    mirror = MapMirror()
    mirror.fetched([mirror.apply("a", b"old", before), mirror.apply("b", b"old", before)])
    assert mirror.complete_to == 900
    old = mirror.apply("b", b"old", before)
    mirror.apply("a", b"new", after)
    mirror.fetched([old])
    assert (mirror.tiles, mirror.complete_to) == ({"a": (3, b"new")}, 0)


def test_a_sample_and_a_reply_may_overtake_each_other():
    mirror = MapMirror()
    for version in (5, 4, 6, 5):
        mirror.apply("a", str(version).encode(), Attachment(version, 0, bytes(16)).encode())
    assert mirror.tiles == {"a": (6, b"6")}
