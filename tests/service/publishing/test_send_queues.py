import threading
import time

from service.encoding import Message
from service.publishing.send_queues import BulkQueue, Sending, StreamQueue
from tests.in_background import started
from tests.service.mapstore.tile_makers import tile


def message(channel: str, number: int = 0) -> Message:
    return Message(channel, "std_msgs/msg/String", number, number, b"")


def test_a_stream_keeps_order_and_lets_the_oldest_go_counted_by_channel():
    queue = StreamQueue(3)
    for number, channel in enumerate(["front/scan", "pose", "front/scan", "pose", "front/scan"]):
        queue.put(Sending(message(channel, number), None))
    assert queue.dropped() == {"front/scan": 1, "pose": 1}
    queue.close()
    assert [sending.message.stamp_ns for sending in queue.take()] == [2, 3, 4]
    assert queue.take() == []


def test_what_comes_after_the_close_is_dropped_and_counted():
    queue = StreamQueue(3)
    queue.close()
    queue.put(Sending(message("pose"), None))
    assert queue.take() == []
    assert queue.dropped() == {"pose": 1}


def test_what_comes_soon_after_another_goes_with_it():
    queue = StreamQueue(3, batch_s=0.5)
    queue.put(Sending(message("front/scan", 1), None))
    later = threading.Timer(0.002, queue.put, [Sending(message("imu/imu", 2), None)])
    later.start()
    assert [sending.message.stamp_ns for sending in queue.take()] == [1, 2]
    later.join()


def test_bulk_keeps_the_newest_of_each_thing():
    queue = BulkQueue(tile_period_s=0.0, picture_period_s=0.0)
    queue.put(message("health", 1))
    queue.put(message("tf_static", 2))
    queue.put(message("health", 3))
    queue.put_tiles([tile(0, 0, 1), tile(1, 0, 2), tile(0, 0, 3)])
    queue.ask_for("map", "map/meta")
    queue.ask_for("map")
    bulk = queue.take()
    assert [(m.channel, m.stamp_ns) for m in bulk.messages] == [("health", 3), ("tf_static", 2)]
    assert [(t.ix, t.version) for t in bulk.tiles] == [(0, 3), (1, 2)]
    assert bulk.pictures == {"map", "map/meta"}


def test_tiles_and_pictures_wait_for_their_period_and_messages_do_not():
    queue = BulkQueue(tile_period_s=0.2, picture_period_s=0.4)
    began_s = time.monotonic()
    queue.put_tiles([tile(0, 0, 1)])
    queue.ask_for("map")
    queue.take()
    queue.put(message("health"))
    queue.put_tiles([tile(0, 0, 2)])
    queue.ask_for("map")
    first_s: dict[str, float] = {}  # when each was given out
    while len(first_s) < 3:
        bulk = queue.take()
        for name in ("messages", "tiles", "pictures"):
            if getattr(bulk, name):
                first_s.setdefault(name, time.monotonic() - began_s)
    assert list(first_s) == ["messages", "tiles", "pictures"]
    assert first_s["tiles"] >= 0.2
    assert first_s["pictures"] >= 0.4


def test_a_closed_bulk_queue_gives_out_what_is_left_at_once():
    queue = BulkQueue(tile_period_s=60.0, picture_period_s=60.0)
    queue.put_tiles([tile(0, 0, 1)])
    assert len(queue.take().tiles) == 1
    queue.put_tiles([tile(0, 0, 2)])
    queue.close()
    assert len(queue.take().tiles) == 1
    assert queue.take() is None


def test_closing_wakes_who_waits():
    for queue, nothing in ((StreamQueue(3), []), (BulkQueue(1.0, 1.0), None)):
        waiting = started(queue.take)
        queue.close()
        assert waiting.result(5.0) == nothing
