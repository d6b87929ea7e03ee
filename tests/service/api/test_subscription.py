import numpy as np
import pytest
import zenoh

import corridor
from service.api import subscription
from service.encoding import encode_frame, encode_pose
from service.geometry.se2 import SE2
from service.mapstore.tiles import TileStore
from service.outputs import NO_REASON, MapperOutput
from service.publishing.config import PublishingConfig
from service.publishing.zenoh_publisher import ZenohPublisher
from tests.service.mapstore.tile_makers import same, tile
from tests.service.publishing.conftest import client_config
from tests.system.machine import free_port
from tests.waiting import wait_until

TIMEOUT_S = 20.0


def pose(stamp_ns: int):
    at = SE2(1.0, 2.0, 0.5)
    output = MapperOutput(stamp_ns, at, SE2(), (0.1, 0.0, 0.0), np.eye(3), "ok", NO_REASON, 1.0)
    return encode_pose(output, stamp_ns)


def scan(stamp_ns: int):
    return encode_frame(corridor.scan([1.0, np.nan, 3.0], 0.0, 0.1, stamp_ns, sensor="front"))


@pytest.fixture
def subscribed(publisher, store):
    """A subscription that has taken the first tile, so the publisher knows it."""
    store.update([tile(2, -3, 1)])
    with corridor.subscribe(publisher.endpoints[0], timeout_s=TIMEOUT_S) as updates:
        assert same(next(updates), tile(2, -3, 1))
        yield updates


def test_poses_scans_and_tiles_come_as_numpy(publisher, store, subscribed):
    publisher.put(pose(7))
    came = next(subscribed)
    assert isinstance(came, corridor.Pose)
    assert (came.stamp_ns, came.x_m, came.y_m, came.state) == (7, 1.0, 2.0, None)
    publisher.put(scan(8))
    came = next(subscribed)
    assert isinstance(came, corridor.LaserScan)
    assert came.sensor == "front"
    np.testing.assert_array_equal(came.range_m, np.float32([1.0, np.nan, 3.0]))
    store.update([tile(2, -3, 2)])
    publisher.map_changed([tile(2, -3, 2)], 9, 9)
    assert same(next(subscribed), tile(2, -3, 2))
    assert subscribed.dropped == 0


def test_of_a_tile_only_the_newest_waits_and_a_stream_loses_its_oldest(
    publisher, store, subscribed, monkeypatch
):
    monkeypatch.setattr(subscription, "MAX_WAITING", 3)
    changed = [tile(0, 0, version) for version in range(2, 6)]
    store.update(changed)
    for one in changed:
        publisher.map_changed([one], 1, 1)
    for stamp_ns in range(10, 21):
        publisher.put(pose(stamp_ns))
    wait_until(lambda: subscribed.dropped == 8)
    stream, tiles = [], []
    while len(stream) < 3 or not tiles or tiles[-1] < 5:  # messages of two keys may overtake each other
        came = next(subscribed)
        stream += [came.stamp_ns] if isinstance(came, corridor.Pose) else []
        tiles += [came.version] if isinstance(came, corridor.TileUpdate) else []
    assert stream == [18, 19, 20]
    assert len(tiles) <= 2


def test_a_tile_that_the_link_lost_is_asked_for_again(publisher, store, monkeypatch):
    monkeypatch.setattr(subscription, "ASK_AGAIN_S", 0.05)
    store.update([tile(2, -3, 1)])
    with corridor.subscribe(publisher.endpoints[0], timeout_s=TIMEOUT_S) as updates:
        assert same(next(updates), tile(2, -3, 1))
        store.update([tile(4, 4, 3)])  # never published
        assert same(next(updates), tile(4, 4, 3))


def test_tiles_of_the_run_before_come_once_more_as_unknown(store):
    """A service that was started again may be in another map: what only the map before had would stay."""
    store.update([tile(2, -3, 1)])
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    config = PublishingConfig(listen=(endpoint,))
    with ZenohPublisher(config, "veh1", store):
        updates = corridor.subscribe(endpoint, "tile", timeout_s=TIMEOUT_S)
        assert same(next(updates), tile(2, -3, 1))
    again = TileStore()
    again.update([tile(4, 4, 1)])
    with updates, ZenohPublisher(config, "veh1", again):
        came = next(updates), next(updates)
    emptied, new = sorted(came, key=lambda one: one.version)
    assert (emptied.ix, emptied.iy, emptied.version) == (2, -3, 0)
    assert (emptied.cells == -1).all()
    assert same(new, tile(4, 4, 1))


def test_only_what_is_asked_for_comes_and_silence_ends_in_words(publisher):
    with (
        corridor.subscribe(publisher.endpoints[0], "pose", vehicle="veh2", timeout_s=0.05) as updates,
        pytest.raises(corridor.CorridorError, match=r"nothing came on corridor/v1/veh2/pose for 0\.05 s"),
    ):
        next(updates)


def test_a_closed_subscription_gives_what_waits_and_ends_the_loop(publisher, subscribed, monkeypatch):
    monkeypatch.setattr(subscription, "MAX_WAITING", 1)
    for stamp_ns in (7, 8):
        publisher.put(pose(stamp_ns))
    wait_until(lambda: subscribed.dropped == 1)
    subscribed.close()
    subscribed.close()
    assert [update.stamp_ns for update in subscribed] == [8]


def test_a_session_of_the_program_is_used(publisher, store):
    store.update([tile(0, 0, 1)])
    session = zenoh.open(client_config(publisher.endpoints[0]))
    with corridor.subscribe(session, ["tile"], timeout_s=TIMEOUT_S) as updates:
        assert same(next(updates), tile(0, 0, 1))
    assert session.is_closed()


def test_where_nothing_answers_the_endpoint_is_named(monkeypatch):
    monkeypatch.setattr(subscription, "CONNECT_S", 0.2)
    with pytest.raises(corridor.StorageError, match=r"no service answers at tcp/127\.0\.0\.1:1 "):
        corridor.subscribe("tcp/127.0.0.1:1")
    with pytest.raises(corridor.StorageError, match="no service answers at nonsense"):
        corridor.subscribe("nonsense")
    with pytest.raises(corridor.UsageError, match="'poses' cannot be subscribed to"):
        corridor.subscribe("tcp/127.0.0.1:1", "poses")  # type: ignore[call-overload]


def test_a_message_that_cannot_be_read_is_in_the_log(publisher, subscribed, caplog):
    broken = pose(1)
    publisher.put(type(broken)("pose", broken.type, 1, 1, b"\x00\x01\x00\x00"))
    publisher.put(pose(2))
    came = next(subscribed)
    assert isinstance(came, corridor.Pose)
    assert came.stamp_ns == 2
    assert "corridor/v1/veh1/pose" in caplog.text


@pytest.mark.parametrize(
    ("what", "vehicle", "words"),
    [("pose", "", "'' is no name of a vehicle"), ("pose", "veh1/#", "no name"), ([], "*", "nothing is subs")],
)
def test_what_cannot_be_a_key_is_refused_before_a_connection_is_made(what, vehicle, words):
    with pytest.raises(corridor.UsageError, match=words):
        corridor.subscribe("tcp/127.0.0.1:1", what, vehicle=vehicle)
