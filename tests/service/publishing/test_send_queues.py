from service.encoding import Message
from service.publishing.send_queues import Sending, StreamQueue


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
