"""The blocks of docs/api.md are run in the order of the page, on a small drive."""

import re
import threading
from collections.abc import Iterator

import numpy as np
import pytest

import corridor
from service.api import subscription
from service.encoding import encode_frame, encode_pose
from service.geometry.se2 import SE2
from service.outputs import NO_REASON, MapperOutput
from tests.docs.blocks import ROOT, written_in
from tests.in_background import in_background
from tests.service.api.rooms import recorded
from tests.service.mapstore.tile_makers import tile
from tests.service.publishing.conftest import open_publisher, publisher, store

__all__ = ["open_publisher", "publisher", "store"]  # fixtures
ENDPOINT = "tcp/127.0.0.1:7447"


def run(page: str, replace: tuple[str, str] = ("", "")) -> dict[str, object]:
    """All of its blocks in one namespace, which is given back."""
    names: dict[str, object] = {}
    for block in written_in("python"):
        if block.page == page:
            exec(compile(block.text.replace(*replace), str(block), "exec"), names)
    return names


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """With session.mcap; the working directory."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "Agg")
    recorded(tmp_path)
    return tmp_path


class Ending(corridor.Subscription):
    """Ends when it has given MOST poses and as many scans, as far as they are subscribed to."""

    MOST = 30

    def __next__(self):
        given = self.__dict__.setdefault("given", dict.fromkeys(self._keys.keys() - {"tile"}, 0))
        if min(given.values()) >= self.MOST:
            raise StopIteration
        update = super().__next__()
        if not isinstance(update, corridor.TileUpdate):
            given["pose" if isinstance(update, corridor.Pose) else "scan"] += 1
        return update


@pytest.fixture
def served(publisher, store, monkeypatch) -> Iterator[str]:
    """The endpoint of a service that publishes; a subscription to it ends after some messages."""
    store.update([tile(0, 0, 1)])
    monkeypatch.setattr(subscription, "Subscription", Ending)

    def serve(over: threading.Event) -> None:
        stamp_ns = 0
        while not over.wait(0.01):
            stamp_ns += 1
            output = MapperOutput(
                *(stamp_ns, SE2(1.0, 2.0, 0.5), SE2(), (0.0, 0.0, 0.0), np.eye(3), "ok", NO_REASON, 1.0)
            )
            publisher.put(encode_pose(output, stamp_ns))
            publisher.put(encode_frame(corridor.scan([1.0, 2.0], 0.0, 0.1, stamp_ns, sensor="front")))

    with in_background(serve):
        yield publisher.endpoints[0]


def test_the_examples_of_the_api_run(folder, served, capsys):
    names = run("docs/api.md", (ENDPOINT, served))
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "50 scans, 0 loop closures"
    assert (folder / "map.png").stat().st_size > 0
    assert (folder / "result" / "map.yaml").exists()
    assert isinstance(names["stored"], corridor.Map)
    assert {"pose 1.0 2.0 0.5", "scan front 2 beams", "tile 0 0 version 1"} <= set(lines)


def test_each_public_name_stands_in_the_table_once():
    page = (ROOT / "docs" / "api.md").read_text(encoding="utf-8")
    table = page.partition("## Names\n")[2]
    names = [
        name
        for cell in re.findall(r"^\| (`.*?) \|", table, re.MULTILINE)
        for name in re.findall(r"`(\w+)`", cell)
    ]
    assert sorted(names) == sorted(corridor.__all__)
    undocumented = [name for name in names if not (getattr(corridor, name).__doc__ or "").strip()]
    assert not undocumented
