"""The fleet's page as a browser sees it, over loopback: vehicles and tiles from a router."""

import asyncio
import json
from contextlib import closing

import aiohttp
import pytest

from service.encoding import encode_pose
from service.errors import InputError
from service.fleet.page import FleetPage
from service.mapstore.files import save_map
from service.mapstore.tiles import TileStore
from tests.service.fleet.conftest import diagnostics
from tests.service.mapstore.tile_makers import tile
from tests.service.test_encoding_outputs import OUTPUT
from tests.waiting import wait_until


def messages(page: FleetPage, enough) -> list[dict]:
    """What a browser gets, until that is enough."""

    async def look() -> list[dict]:
        found: list[dict] = []
        async with (
            aiohttp.ClientSession() as session,
            session.ws_connect(f"{page.address}ws", headers={"Origin": page.address.rstrip("/")}) as socket,
        ):
            async with asyncio.timeout(30.0):
                async for message in socket:
                    if message.type == aiohttp.WSMsgType.TEXT:
                        found.append(json.loads(message.data))
                    if enough(found):
                        return found
        raise AssertionError("closed")

    return asyncio.run(look())


def last(found: list[dict], kind: str) -> dict | None:
    return next((one for one in reversed(found) if one["type"] == kind), None)


def rows(found: list[dict]) -> dict[str, dict]:
    health = last(found, "health")
    return {row["name"]: row for row in health["statuses"]} if health else {}


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
        wait_until(
            lambda key=f"corridor/v1/{name}/health": list(open_client(endpoint).get(key, timeout=20.0))
        )
    with closing(FleetPage(open_client(endpoint), "127.0.0.1:0")) as page:
        found = messages(page, lambda all_: len((last(all_, "vehicles") or {}).get("vehicles", ())) == 2)
        places = {one["name"]: one for one in last(found, "vehicles")["vehicles"]}
        assert places["veh1"]["x_m"] == pytest.approx(OUTPUT.pose_map_base.x_m)
        assert (places["veh1"]["is_well"], places["veh2"]["is_well"]) == (False, True)
        statuses = rows(messages(page, lambda all_: "vehicle/veh2" in rows(all_)))
        assert statuses["mapping"]["message"] == "2 vehicles, 1 of them well"
        assert (statuses["vehicle/veh1"]["level"], statuses["vehicle/veh1"]["message"]) == (2, "lost")
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
