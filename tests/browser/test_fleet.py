"""The page of a fleet: vehicles of a router on loopback, shown on the map of their tiles."""

from contextlib import closing

import pytest

from service.encoding import encode_pose
from service.fleet.page import FleetPage
from service.mapstore.tiles import TileStore
from tests.service.fleet.conftest import (  # noqa: F401 - fixtures
    diagnostics,
    endpoint,
    open_client,
    open_session,
    router,
    site,
    start_router,
    start_vehicle,
)
from tests.service.mapstore.tile_makers import tile
from tests.service.test_encoding_outputs import OUTPUT

STALE = [74, 87, 104]  # of the light theme


@pytest.fixture
def fleet_page(endpoint, router, start_vehicle, open_client):  # noqa: F811
    store = TileStore()
    store.update([tile(x, y, 1, value=0, edge=64) for x in (-1, 0) for y in (-1, 0)])
    sink = start_vehicle(endpoint, tiles=store)
    sink.put(encode_pose(OUTPUT, 1))
    sink.put(diagnostics("lost"))
    with closing(FleetPage(open_client(endpoint), "127.0.0.1:0")) as served:
        yield served


def test_a_vehicle_is_shown_at_its_pose_with_the_reason_of_its_state(page, fleet_page):
    page.open(fleet_page.address)
    page.wait_for("return corridor.fleet.vehicles.length === 1 && corridor.report().tiles === 4")
    page.wait_for_text("reason", "1 vehicle, 0 of them well")
    page.wait_for_text("information", "vehicle/veh1")
    at = OUTPUT.pose_map_base
    page.run(
        "window.words = []; const {context} = corridor.view;context.fillText = (text) => words.push(text);"
    )
    page.look_at(at.x_m, at.y_m, 40.0)
    assert "veh1: lost" in page.run("return words")
    assert page.pixel(at.x_m, at.y_m) == STALE
    assert page.faults() == []
