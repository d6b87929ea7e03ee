import math
from collections.abc import Callable

import pytest

from drivers.irobot_create.protocol import (
    Mode,
    Opcode,
    StreamDecoder,
    decode_values,
    encode_stream_request,
    frame_bytes,
)
from simulators.irobot_create import FLASH_TEXT, FakeCreate

S, MS = 1_000_000_000, 1_000_000
M_PER_COUNT = math.pi * 0.072 / 508.8


class Rolling:
    """WheelSource of constant speeds, m/s."""

    def __init__(self, left_mps: float, right_mps: float) -> None:
        self.speeds = (left_mps, right_mps)

    def wheel_travel_m(self, now_ns: int) -> tuple[float, float]:
        return self.speeds[0] * now_ns / S, self.speeds[1] * now_ns / S


STANDING = Rolling(0.0, 0.0)


@pytest.fixture
def started() -> Callable[..., FakeCreate]:
    def start(wheels: Rolling = STANDING, *args: object, **settings: object) -> FakeCreate:
        robot = FakeCreate(wheels, *args, **settings)  # type: ignore[arg-type]
        robot.receive_data(bytes([128]), 0)
        return robot

    return start


def ask(robot: FakeCreate, packet_id: int, now_ns: int = 0) -> dict[int, int]:
    return decode_values([packet_id], robot.receive_data(bytes([142, packet_id]), now_ns))


def run(robot: FakeCreate, until_ns: int) -> list[tuple[int, bytes]]:
    """What it sends up to a moment, each at its due time."""
    sent, now_ns = [], 0
    while (due_ns := robot.next_due_ns(now_ns)) is not None and due_ns <= until_ns:
        now_ns = due_ns
        sent.append((now_ns, robot.due(now_ns)))
    return sent


def test_it_is_silent_and_deaf_until_start():
    robot = FakeCreate(STANDING)
    assert robot.connected(0) == b""
    assert robot.receive_data(bytes([131, 142, 100, 148, 1, 7]), 0) == b""
    assert robot.next_due_ns(0) is None
    assert robot.mode is Mode.OFF
    robot.receive_data(bytes([128]), 1)
    assert len(robot.receive_data(bytes([142, 100]), 2)) == 80


def test_stream_comes_every_fifteen_milliseconds_and_takes_its_time_on_the_wire(
    started: Callable[..., FakeCreate],
):
    robot = started(Rolling(0.5, 0.5))
    robot.receive_data(encode_stream_request([43, 44]), 2 * MS)
    sent = run(robot, 2 * S)
    wire_ns = round(frame_bytes([43, 44]) * 10e9 / 115_200)
    assert [at for at, _ in sent] == [2 * MS + 15 * MS * (i + 1) + wire_ns for i in range(len(sent))]
    assert len(sent) == 133
    (frame,) = StreamDecoder([43, 44]).receive_data(sent[99][1])
    assert frame.values[43] == math.floor(0.5 * 1.502 / M_PER_COUNT)  # when measured, not when sent


def test_distance_and_angle_clear_on_reading_and_lose_the_fraction(started: Callable[..., FakeCreate]):
    robot = started(Rolling(0.1, 0.2), "create1")
    assert ask(robot, 19, S) == {19: 150}
    assert ask(robot, 19, S) == {19: 0}
    assert ask(robot, 20, S) == {20: math.floor(math.degrees(0.1 / 0.258))}
    lost = started(Rolling(-0.05, 0.05), "create1")  # 22 deg/s
    assert sum(ask(lost, 20, i * 15 * MS)[20] for i in range(1000)) == 0
    assert ask(started(Rolling(1.0, 1.0), "create1"), 19, 100 * S) == {19: 32_767}


def test_it_sleeps_after_five_minutes_of_passive_and_only_the_wake_line_helps(
    started: Callable[..., FakeCreate],
):
    robot = started()
    robot.receive_data(encode_stream_request([35]), 0)
    robot.due(299 * S)
    assert robot.next_due_ns(299 * S) is not None
    assert robot.due(300 * S) == b""
    assert robot.asleep
    assert robot.receive_data(bytes([128, 142, 35]), 301 * S) == b""
    robot.wake(302 * S)
    assert robot.receive_data(bytes([128, 142, 35]), 303 * S) == b"\x01"


def test_it_speaks_unasked_between_and_inside_frames(started: Callable[..., FakeCreate]):
    robot = started(text_every_ns=120 * S, sleep_after_ns=None)
    robot.receive_data(encode_stream_request([43, 44]), 0)
    sent = [data for _, data in run(robot, 250 * S)]
    speaking = [data for data in sent if FLASH_TEXT in data]
    assert len(speaking) == 2
    assert speaking[0].replace(FLASH_TEXT, b"") in (b"", sent[0])
    assert speaking[1][0] == 0x13
    assert not speaking[1].endswith(FLASH_TEXT)
    decoder = StreamDecoder([43, 44])
    frames = sum(len(decoder.receive_data(data)) for data in sent)
    assert frames == sum(1 for data in sent if data != FLASH_TEXT) - 1


def test_pycreate2_dialogue(started: Callable[..., FakeCreate]):
    """What pycreate2 0.8 sends: start, safe, four songs cleared, group 100, drive direct, and its close."""
    robot = FakeCreate(STANDING)
    songs = b"".join(bytes([140, n, 1, 70, 0, 141, n]) for n in range(4))
    assert robot.receive_data(bytes([128]), 0) == b""
    assert robot.receive_data(bytes([131]) + songs, S) == b""
    answer = robot.receive_data(bytes([142, 100]), 2 * S)
    assert len(answer) == 80
    assert decode_values([100], answer)[35] == 2
    assert robot.receive_data(bytes([145, 0, 100, 0, 100]), 3 * S) == b""
    assert decode_values([100], robot.receive_data(bytes([142, 100]), 3 * S))[41] == 100
    bye = bytes([145, 0, 0, 0, 0, 139, 0, 0, 0, 164, 32, 32, 32, 32]) + songs + bytes([173])
    assert robot.receive_data(bye, 4 * S) == b""
    assert robot.mode is Mode.OFF
    assert [c.opcode for c in robot.commands[-3:]] == [Opcode.SONG, Opcode.PLAY, Opcode.STOP]
