"""The fleet's page as a browser sees it, over loopback: vehicles and tiles from a router."""

from contextlib import closing

import pytest

from service.encoding import encode_pose
from service.errors import InputError
from service.fleet.page import FleetPage
from service.mapstore.files import save_map
from service.mapstore.tiles import TileStore
from tests.service.fleet.conftest import diagnostics
from tests.service.mapstore.tile_makers import tile
from tests.service.test_encoding_outputs import OUTPUT
from tests.service.web.conftest import talk
from tests.waiting import wait_until


def test_vehicles_are_on_the_map_with_their_state_and_the_map_is_of_their_tiles(
    endpoint, router, start_vehicle, open_client
):
    stores = {}
    for number, name in enumerate(("veh1", "veh2")):
        stores[name] = TileStore()
        stores[name].update([tile(number, 0, 1, value=50, edge=64)])
        sink = start_vehicle(endpoint, name, tiles=stores[name])
        sink.put(encode_pose(OUTPUT, 1))
        sink.put(diagnostics("ok" if number else "lost"))
        client = open_client(endpoint)
        wait_until(lambda key=f"corridor/v1/{name}/health", on=client: list(on.get(key, timeout=20.0)))

    async def look(client):
        async with client.socket() as socket:
            places = {}
            while len(places) < 2:
                shown = (await client.next(socket, "vehicles"))["vehicles"]
                places = {one["name"]: one for one in shown}
            assert places["veh1"]["x_m"] == pytest.approx(OUTPUT.pose_map_base.x_m)
            assert (places["veh1"]["is_well"], places["veh2"]["is_well"]) == (False, True)
            rows = {}
            while "vehicle/veh2" not in rows:
                rows = {row["name"]: row for row in (await client.next(socket, "health"))["statuses"]}
            assert rows["mapping"]["message"] == "2 vehicles, 1 of them well"
            assert (rows["vehicle/veh1"]["level"], rows["vehicle/veh1"]["message"]) == (2, "lost")

    with closing(FleetPage(open_client(endpoint), "127.0.0.1:0")) as page:
        talk(page, look)
        wait_until(lambda: {(t.ix, t.iy) for t in page.store.since(0)} == {(0, 0), (1, 0)})
        changed = tile(1, 0, 2, value=100, edge=64)
        stores["veh2"].update([changed])
        sink.put_tiles([changed], 1, 1)
        wait_until(lambda: page.store.since(0)[-1].cells.max() == 100)


def test_tiles_that_changed_without_a_link_come_when_the_vehicle_is_here_again(
    endpoint, start_router, start_vehicle, open_client
):
    router, store = start_router(endpoint), TileStore()
    sink = start_vehicle(endpoint, tiles=store)
    store.update([tile(0, 0, 1, edge=64)])
    with closing(FleetPage(open_client(endpoint), "127.0.0.1:0")) as page:
        wait_until(lambda: page.store.version == 1)
        router.close()
        wait_until(lambda: not page.vehicles["veh1"].sessions)
        store.update([tile(5, 0, 2, edge=64)])
        start_router(endpoint)
        wait_until(lambda: sink.put(diagnostics()) or page.store.version == 2)
        assert page.versions == {"veh1": 2}


def test_with_a_stored_map_the_tiles_of_the_vehicles_are_left_out(
    endpoint, router, start_vehicle, open_client, tmp_path
):
    save_map(tmp_path / "site", [tile(7, 7, 1, edge=64)], 1)
    store = TileStore()
    store.update([tile(0, 0, 5, edge=64)])
    start_vehicle(endpoint, tiles=store)
    with closing(FleetPage(open_client(endpoint), "127.0.0.1:0", tmp_path / "site")) as page:
        wait_until(lambda: "veh1" in page.vehicles)
        assert [(t.ix, t.iy) for t in page.store.since(0)] == [(7, 7)]
    with pytest.raises(InputError, match="no stored map"):
        FleetPage(open_client(endpoint), "127.0.0.1:0", tmp_path / "nothing")
