from collections.abc import Callable

import numpy as np
import pytest
import zenoh

import corridor
from service.api import subscription
from service.encoding import encode_frame, encode_pose
from service.geometry.se2 import SE2
from service.outputs import NO_REASON, MapperOutput
from tests.service.mapstore.tile_makers import same, tile
from tests.service.publishing.conftest import client_config

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


def wait_for(subscribed: corridor.Subscription, is_so: Callable[[], bool]) -> None:
    with subscribed._changed:
        assert subscribed._changed.wait_for(is_so, TIMEOUT_S)


def test_of_a_tile_only_the_newest_waits_and_a_stream_loses_its_oldest(
    publisher, store, subscribed, monkeypatch
):
    monkeypatch.setattr(subscription, "MAX_WAITING", 3)
    changed = [tile(0, 0, version) for version in range(2, 6)]
    store.update(changed)
    for one in changed:
        publisher.map_changed([one], 1, 1)
    for stamp_ns in range(10, 20):
        publisher.put(pose(stamp_ns))
    wait_for(subscribed, lambda: subscribed.dropped == 7)  # messages of two keys may overtake each other
    publisher.put(scan(20))
    wait_for(
        subscribed,
        lambda: subscribed.dropped == 8 and any(t.version == 5 for t in subscribed._tiles.values()),
    )
    came = [next(subscribed) for _ in range(4)]
    assert isinstance(came[1], corridor.TileUpdate)  # in turn with the stream
    assert came.pop(1).version == 5
    assert [one.stamp_ns for one in came] == [18, 19, 20]


def test_a_tile_that_the_link_lost_is_asked_for_again(publisher, store, subscribed, monkeypatch):
    monkeypatch.setattr(subscription, "ASK_AGAIN_S", 0.05)
    subscribed._ask_at_s = 0.0
    store.update([tile(4, 4, 3)])  # never published
    assert same(next(subscribed), tile(4, 4, 3))


def test_only_what_is_asked_for_comes_and_silence_ends_in_words(publisher):
    with (
        corridor.subscribe(publisher.endpoints[0], "pose", vehicle="veh2", timeout_s=0.05) as updates,
        pytest.raises(corridor.CorridorError, match=r"nothing came on corridor/v1/veh2/pose for 0\.05 s"),
    ):
        next(updates)


def test_a_closed_subscription_gives_what_waits_and_ends_the_loop(publisher, subscribed):
    publisher.put(pose(7))
    wait_for(subscribed, lambda: len(subscribed._stream) == 1)
    subscribed.close()
    subscribed.close()
    assert [update.stamp_ns for update in subscribed] == [7]


def test_a_session_of_the_program_is_used(publisher, store):
    store.update([tile(0, 0, 1)])
    session = zenoh.open(client_config(publisher.endpoints[0]))
    with corridor.subscribe(session, ["tile"], timeout_s=TIMEOUT_S) as updates:
        assert same(next(updates), tile(0, 0, 1))
    assert session.is_closed()


LEFT_OPEN = """
import atexit, sys, corridor
atexit.register(lambda: print("closed:", updates._session.is_closed()))  # after what is registered later
updates = corridor.subscribe(sys.argv[1])
for update in updates:
    sys.exit(3)
"""


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
