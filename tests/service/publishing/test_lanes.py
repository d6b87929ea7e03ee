import threading
import time

from service.encoding import Message
from service.publishing.lanes import BulkLane, Sending, StreamLane
from tests.service.mapstore.tile_makers import tile


def message(channel: str, number: int = 0) -> Message:
    return Message(channel, "std_msgs/msg/String", number, number, b"")


def test_a_stream_keeps_order_and_lets_the_oldest_go_counted_by_channel():
    lane = StreamLane(3)
    for number, channel in enumerate(["front/scan", "pose", "front/scan", "pose", "front/scan"]):
        lane.put(Sending(message(channel, number), None))
    assert lane.dropped() == {"front/scan": 1, "pose": 1}
    lane.close()
    assert [lane.take().message.stamp_ns for _ in range(3)] == [2, 3, 4]
    assert lane.take() is None


def test_what_comes_after_the_close_is_dropped_and_counted():
    lane = StreamLane(3)
    lane.close()
    lane.put(Sending(message("pose"), None))
    assert lane.take() is None
    assert lane.dropped() == {"pose": 1}


def test_bulk_keeps_the_newest_of_each_thing():
    lane = BulkLane(tile_period_s=0.0, picture_period_s=0.0)
    lane.put(message("health", 1))
    lane.put(message("tf_static", 2))
    lane.put(message("health", 3))
    lane.put_tiles([tile(0, 0, 1), tile(1, 0, 2), tile(0, 0, 3)])
    lane.ask_for("map", "map/meta")
    lane.ask_for("map")
    bulk = lane.take()
    assert [(m.channel, m.stamp_ns) for m in bulk.messages] == [("health", 3), ("tf_static", 2)]
    assert [(t.ix, t.version) for t in bulk.tiles] == [(0, 3), (1, 2)]
    assert bulk.pictures == {"map", "map/meta"}


def test_tiles_and_pictures_wait_for_their_period_and_messages_do_not():
    lane = BulkLane(tile_period_s=0.2, picture_period_s=0.4)
    began_s = time.monotonic()
    lane.put_tiles([tile(0, 0, 1)])
    lane.ask_for("map")
    lane.take()
    lane.put(message("health"))
    lane.put_tiles([tile(0, 0, 2)])
    lane.ask_for("map")
    first_s: dict[str, float] = {}  # when each was given out
    while len(first_s) < 3:
        bulk = lane.take()
        for name in ("messages", "tiles", "pictures"):
            if getattr(bulk, name):
                first_s.setdefault(name, time.monotonic() - began_s)
    assert list(first_s) == ["messages", "tiles", "pictures"]
    assert first_s["tiles"] >= 0.2
    assert first_s["pictures"] >= 0.4


def test_a_closed_bulk_lane_gives_out_what_is_left_at_once():
    lane = BulkLane(tile_period_s=60.0, picture_period_s=60.0)
    lane.put_tiles([tile(0, 0, 1)])
    assert len(lane.take().tiles) == 1
    lane.put_tiles([tile(0, 0, 2)])
    lane.close()
    assert len(lane.take().tiles) == 1
    assert lane.take() is None


def test_closing_wakes_who_waits():
    for lane in (StreamLane(3), BulkLane(1.0, 1.0)):
        taken = []
        waiter = threading.Thread(target=lambda lane=lane, taken=taken: taken.append(lane.take()))
        waiter.start()
        lane.close()
        waiter.join(timeout=5.0)
        assert taken == [None]
