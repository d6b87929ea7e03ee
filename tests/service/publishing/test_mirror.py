"""mirror.py, the program that docs/subscribing.md offers, in processes of its own."""

import hashlib
import json
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from service.mapstore.tiles import TileStore
from tests.in_background import in_background
from tests.service.mapstore.tile_makers import tile
from tests.waiting import wait_until

HERE = Path(__file__).parent

# Joins, says so, follows until stdin says which version is the last, and prints what it holds then.
JOINER = """
import hashlib, json, sys, threading, zenoh
from mirror import MapMirror, connect, follow

with connect(sys.argv[1]) as session:
    mirror = MapMirror()
    subscriber, fetch = follow(session, "veh1", mirror)
    fetch()
    joined_at = mirror.complete_to
    print("joined", flush=True)
    last = int(sys.stdin.readline())
    pause = threading.Event()
    while max(version for version, _ in mirror.tiles.values()) < last:
        pause.wait(0.01)
    live = max(version for version, _ in mirror.tiles.values())
    fetch()
    kept = {}
    for key, (version, _) in mirror.tiles.items():
        kept[key.split("/tile/")[1]] = [version, hashlib.sha256(mirror.cells(key).tobytes()).hexdigest()]
    print(json.dumps({"joined_at": joined_at, "live": live, "complete_to": mirror.complete_to, "kept": kept}))
"""


@pytest.fixture
def programs(tmp_path) -> Path:
    shutil.copy(HERE / "mirror.py", tmp_path)
    (tmp_path / "joiner.py").write_text(JOINER)
    return tmp_path


@pytest.fixture
def join(programs, publisher) -> Iterator[object]:
    running = []

    def start() -> subprocess.Popen:
        command = [sys.executable, str(programs / "joiner.py"), publisher.endpoints[0]]
        joiner = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        running.append(joiner)
        return joiner

    yield start
    for joiner in running:
        joiner.kill()
        joiner.communicate()


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


def versions_in(store: TileStore) -> dict[str, list[object]]:
    return {
        f"{t.level}/{t.ix}/{t.iy}": [t.version, hashlib.sha256(t.cells.tobytes()).hexdigest()]
        for t in store.since(0)
    }


def test_whoever_joins_while_the_map_changes_ends_with_the_same_map(join, mapping, store):
    joiners = []
    for _ in range(3):  # one after the other, so that each joins another state
        joiners.append(join())
        assert joiners[-1].stdout.readline() == "joined\n"
    last = mapping()
    results = [json.loads(joiner.communicate(f"{last}\n", timeout=20.0)[0]) for joiner in joiners]
    for result in results:
        assert result["kept"] == versions_in(store)
        assert result["live"] == result["complete_to"] == last
        assert result["joined_at"] < last  # so what came after was heard, not asked for
    joined_at = [result["joined_at"] for result in results]
    assert joined_at == sorted(joined_at)


def test_the_mirror_forgets_a_former_run(programs, monkeypatch):
    monkeypatch.syspath_prepend(str(programs))
    from mirror import MapMirror

    from drivers.rmw_zenoh import Attachment

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


def test_a_sample_and_a_reply_may_overtake_each_other(programs, monkeypatch):
    monkeypatch.syspath_prepend(str(programs))
    from mirror import MapMirror

    from drivers.rmw_zenoh import Attachment

    mirror = MapMirror()
    for version in (5, 4, 6, 5):
        mirror.apply("a", str(version).encode(), Attachment(version, 0, bytes(16)).encode())
    assert mirror.tiles == {"a": (6, b"6")}
