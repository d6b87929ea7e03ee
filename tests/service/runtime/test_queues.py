import threading

import numpy as np
import pytest

from drivers.frames import NO_INTENSITY, LaserScan, OdometrySample
from service.runtime.queues import COMMAND_CAPACITY, Command, FrameQueue


def scan(stamp_ns: int, sensor: str = "front") -> LaserScan:
    ranges = np.ones(3, dtype=np.float32)
    return LaserScan(sensor, stamp_ns, stamp_ns, 1, 3, 0.0, 0.1, 0.01, 20.0, ranges, NO_INTENSITY)


def sample(stamp_ns: int) -> OdometrySample:
    return OdometrySample("base", stamp_ns, stamp_ns, 0.0, 0.0, 0.0, (0.0, 0.0, 0.0), (0.0,) * 9)


def stamps(queue: FrameQueue) -> list[int]:
    taken = []
    while (frame := queue.get(0.0)) is not None:
        taken.append(frame.stamp_ns)
    return taken


def test_frames_leave_in_the_order_they_came():
    queue = FrameQueue()
    for frame in (sample(3), scan(1), sample(2)):
        queue.put(frame)
    assert stamps(queue) == [3, 1, 2]


def test_the_oldest_scan_makes_room_and_samples_stay():
    queue = FrameQueue(scan_capacity=2)
    for frame in (sample(0), scan(1), sample(2), scan(3, "rear"), scan(4), scan(5)):
        queue.put(frame)
    assert stamps(queue) == [0, 2, 4, 5]
    assert queue.dropped_scans == {"front": 1, "rear": 1}
    assert queue.deepest == 4


def test_scans_taken_out_give_their_room_back():
    queue = FrameQueue(scan_capacity=1)
    for stamp_ns in range(5):
        queue.put(scan(stamp_ns))
        assert stamps(queue) == [stamp_ns]
    assert not queue.dropped_scans


def test_a_stuck_mapping_thread_is_said_out_loud():
    queue = FrameQueue(sample_capacity=2)
    queue.put(sample(0))
    queue.put(sample(1))
    with pytest.raises(OverflowError, match="base: 2 samples wait"):
        queue.put(sample(2))
    queue.put(scan(3))  # scans have room of their own
    assert stamps(queue) == [0, 1, 3]


def test_an_empty_queue_gives_up_after_its_timeout():
    assert FrameQueue().get(0.001) is None


def test_a_closed_queue_still_hands_out_what_waits_and_takes_no_more():
    queue = FrameQueue()
    queue.put(scan(1))
    queue.close()
    queue.put(scan(2))
    assert not queue.drained
    assert stamps(queue) == [1]
    assert queue.drained


def test_closing_wakes_a_waiting_reader():
    queue = FrameQueue()
    answers = []
    reader = threading.Thread(target=lambda: answers.append(queue.get(60.0)))
    reader.start()
    queue.close()
    reader.join(5.0)
    assert answers == [None]


def command(at_ns: int) -> Command:
    return Command(at_ns, {"event": "mark"}, lambda event: None)


def test_commands_keep_their_place_and_are_neither_dropped_nor_counted_as_samples():
    queue = FrameQueue(scan_capacity=1, sample_capacity=1)
    queue.put(scan(1))
    assert queue.put_command(command(2)) == ""
    queue.put(sample(3))
    assert queue.put_command(command(4)) == ""
    queue.put(scan(5))
    items = [queue.get(0.0) for _ in range(4)]
    assert [item.arrived_ns if isinstance(item, Command) else item.stamp_ns for item in items if item] == [
        2, 3, 4, 5,
    ]  # fmt: skip
    assert queue.dropped_scans == {"front": 1}
    queue.put(sample(6))


def test_too_many_commands_and_those_after_the_end_are_refused_with_words():
    queue = FrameQueue()
    for at_ns in range(COMMAND_CAPACITY):
        assert queue.put_command(command(at_ns)) == ""
    assert queue.put_command(command(99)) == f"{COMMAND_CAPACITY} commands wait for the mapping thread"
    assert queue.get(0.0) is not None
    assert queue.put_command(command(99)) == ""
    queue.close()
    assert queue.put_command(command(99)) == "the service is stopping"
