"""A stored map to vehicles over loopback: all begin in it, or none stays in it."""

import json
from pathlib import Path

import pytest

from service.encoding import OK, Status, encode_diagnostics
from service.fleet.push import push
from service.fleet.queries import RefusedError, ask
from service.mapstore.files import load_map, save_map
from service.mapstore.manifest import MANIFEST
from service.sinks.fleet_files import MAPS
from tests.service.cli.test_commands import code_of
from tests.service.mapstore.tile_makers import graph_of, tile
from tests.service.runtime.test_commands import Machine
from tests.waiting import wait_until

NAMES = ("veh1", "veh2")
PUSHED = "site_v000001"


@pytest.fixture
def site_map(tmp_path) -> Path:
    folder = tmp_path / "site"
    tiles = [tile(x, y, 1 + x + 10 * y, edge=64) for x in range(10) for y in range(10)]  # 400 kB, not packed
    save_map(folder, tiles, 1, {"vehicle": "survey"}, graph=graph_of(20))
    return folder


@pytest.fixture
def machines(tmp_path, endpoint, router, start_vehicle, open_client):
    made = {}
    for name in NAMES:
        machine = made[name] = Machine(tmp_path / name, [1 << 40])
        machine.start()
        machine.scan(3)
        sink = start_vehicle(
            endpoint, name, command=machine.dispatcher.answer, folders={"map": tmp_path / name}
        )
        rows = [Status("mapping", OK, "ok", {"state": "ok"}), Status("map", OK, "ok", {"folder": "map"})]
        sink.put(encode_diagnostics("diagnostics", rows, 1, 1))
        client = open_client(endpoint)
        wait_until(lambda key=f"corridor/v1/{name}/health", on=client: list(on.get(key, timeout=20.0)))
    yield made
    for machine in made.values():
        machine.stop()


def states(pushed) -> dict[str, str]:
    return {one.vehicle: one.state for one in pushed}


def test_every_vehicle_begins_in_the_map_that_was_brought(machines, client, site_map, tmp_path):
    assert states(push(client, site_map, None, NAMES)) == dict.fromkeys(NAMES, "active")
    for name, machine in machines.items():
        assert machine.prepared == [(str(tmp_path / name / PUSHED), 1)]
        brought = load_map(tmp_path / name / PUSHED)
        assert len(brought.tiles) == 100
        assert brought.about == {"vehicle": "survey"}
        assert not list((tmp_path / name).glob(".incoming*"))


def test_where_one_cannot_begin_all_go_back_to_the_map_before(machines, client, site_map, tmp_path):
    machines["veh2"].mapper_fault = "out of memory"
    pushed = push(client, site_map, None, NAMES)
    assert states(pushed) == dict.fromkeys(NAMES, "as before")
    assert "out of memory" in pushed[1].error
    assert [Path(folder).name for folder, _ in machines["veh1"].prepared] == [PUSHED, "map"]
    assert machines["veh2"].prepared == []


def test_where_one_cannot_take_it_none_begins(machines, client, site_map, tmp_path):
    save_map(tmp_path / "veh2" / PUSHED, [tile(0, 0, 5)], 1, graph=graph_of(3))  # another map of that name
    pushed = push(client, site_map, None, NAMES)
    assert states(pushed) == {"veh1": "brought", "veh2": "not brought"}
    assert "another map" in pushed[1].error
    assert machines["veh1"].prepared == []
    assert states(push(client, site_map, None, NAMES, "new")) == dict.fromkeys(NAMES, "active")


def test_where_one_is_not_there_nothing_is_brought(machines, client, site_map, tmp_path):
    pushed = push(client, site_map, None, (*NAMES, "veh3"))
    assert [one.error for one in pushed if one.vehicle == "veh3"] == ["it does not answer"]
    assert not (tmp_path / "veh1" / PUSHED).exists()


def test_what_is_damaged_in_transfer_does_not_become_a_map(machines, client, site_map, tmp_path):
    source = site_map / "v000001"
    ask(client, "veh1", f"{MAPS}/{PUSHED}/{MANIFEST}?offset=0", (source / MANIFEST).read_bytes())
    for path in source.iterdir():
        if path.name != MANIFEST:
            content = path.read_bytes()
            while content:
                at = path.stat().st_size - len(content)
                damaged = bytes([content[0] ^ 1]) + content[1 : 1 << 18]
                ask(client, "veh1", f"{MAPS}/{PUSHED}/{path.name}?offset={at}", damaged)
                content = content[1 << 18 :]
    with pytest.raises(RefusedError, match="damaged"):
        ask(client, "veh1", f"{MAPS}/{PUSHED}?commit=1")
    assert not (tmp_path / "veh1" / PUSHED).exists()
    assert states(push(client, site_map, None, NAMES)) == dict.fromkeys(NAMES, "active")  # it is sent again


@pytest.mark.parametrize(
    ("channel", "words"),
    [
        ("site/passwd?offset=0", "manifest"),  # before its manifest
        ("..x/a?offset=0", "is no map"),
        (f"site/{MANIFEST}?offset=9", "leaves a gap"),
        ("site/a?offset=x", "offset=x: expected a number"),
        ("site/.hidden?offset=0", "no file of a map"),
        ("site/a/b?offset=0", "is no map"),
    ],
)
def test_what_belongs_to_no_map_is_refused(machines, client, tmp_path, channel, words):
    with pytest.raises(RefusedError, match=words):
        ask(client, "veh1", f"{MAPS}/{channel}", b"payload")
    assert not (tmp_path / "veh1/site").exists()


def test_the_command_says_what_became_of_it(machines, site_file, site_map, capsys):
    command = ["fleet", "push", "--site", site_file, f"{site_map}@1", *NAMES]
    assert code_of(command) == 0
    assert capsys.readouterr().out == "veh1: active\nveh2: active\n"
    assert code_of([*command, "veh3", "--json"]) == 1
    assert json.loads(capsys.readouterr().out)["vehicles"]["veh3"]["state"] == "as before"
