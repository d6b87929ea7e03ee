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
from simulators.irobot_create import BANNER, FLASH_TEXT, IDLE_VALUES, FakeCreate

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


def test_modes_follow_the_commands(started: Callable[..., FakeCreate]):
    robot = started()
    for opcode, mode in [(131, 2), (128, 1), (130, 2), (132, 3), (143, 1), (132, 3), (173, 0), (128, 1)]:
        robot.receive_data(bytes([opcode]), 0)
        assert robot.mode == mode
    assert ask(robot, 35) == {35: 1}
    assert ask(started(mode_one_too_high=True), 35) == {35: 2}


@pytest.mark.parametrize(
    ("group", "length"),
    [(0, 26), (1, 10), (2, 6), (3, 10), (4, 14), (5, 12), (6, 52), (100, 80), (101, 28), (106, 12), (107, 9)],
)
def test_groups_are_answered_whole(started: Callable[..., FakeCreate], group: int, length: int):
    assert len(started().receive_data(bytes([142, group]), 0)) == length


def test_query_list_is_answered_in_its_order(started: Callable[..., FakeCreate]):
    answer = started().receive_data(bytes([149, 3, 26, 35, 22]), 0)
    assert decode_values([26, 35, 22], answer) == {26: IDLE_VALUES[26], 35: 1, 22: IDLE_VALUES[22]}
    assert answer[2] == 1


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


def test_stream_pauses_resumes_and_ends(started: Callable[..., FakeCreate]):
    robot = started()
    robot.receive_data(encode_stream_request([35]), 0)
    robot.receive_data(bytes([150, 0]), 1)
    assert robot.next_due_ns(1) is None
    robot.receive_data(bytes([150, 1]), 2)
    assert robot.next_due_ns(2) is not None
    robot.receive_data(bytes([150, 1]), 5 * MS)
    due_ns = robot.next_due_ns(5 * MS)
    assert due_ns is not None
    assert due_ns < 16 * MS  # resuming what runs does not shift it
    robot.receive_data(bytes([148, 0]), 6 * MS)
    assert robot.next_due_ns(6 * MS) is None


def test_stalled_wire_gets_what_is_owed_and_an_absent_client_nothing(started: Callable[..., FakeCreate]):
    robot = started()
    robot.receive_data(encode_stream_request([35]), 0)
    assert len(robot.due(160 * MS)) == 10 * frame_bytes([35])
    robot.disconnected(200 * MS)
    robot.connected(60 * S)
    assert len(robot.due(60 * S)) <= 2 * frame_bytes([35])


def test_distance_and_angle_clear_on_reading_and_lose_the_fraction(started: Callable[..., FakeCreate]):
    robot = started(Rolling(0.1, 0.2), "create1")
    assert ask(robot, 19, S) == {19: 150}
    assert ask(robot, 19, S) == {19: 0}
    assert ask(robot, 20, S) == {20: math.floor(math.degrees(0.1 / 0.258))}
    lost = started(Rolling(-0.05, 0.05), "create1")  # 22 deg/s
    assert sum(ask(lost, 20, i * 15 * MS)[20] for i in range(1000)) == 0
    assert ask(started(Rolling(1.0, 1.0), "create1"), 19, 100 * S) == {19: 32_767}


def test_drive_commands_set_what_is_requested_and_move_nothing(started: Callable[..., FakeCreate]):
    robot = started()
    robot.receive_data(bytes([145, 0, 100, 0, 50]), 0)
    assert ask(robot, 5)[41] == 0  # Passive does not drive
    robot.receive_data(bytes([131]), 0)
    robot.receive_data(bytes([145, 0, 100, 0xFF, 0xCE]), 0)
    values = ask(robot, 6)
    assert (values[41], values[42]) == (100, -50)
    robot.receive_data(bytes.fromhex("89 FF 38 01 F4"), 0)  # the manual's example: -200 mm/s, radius 500
    values = ask(robot, 100, S)
    assert (values[39], values[40]) == (-200, 500)
    assert (values[41], values[42]) == (-247, -153)
    assert (values[43], values[44]) == (0, 0)


@pytest.mark.parametrize(
    ("radius", "right", "left"),
    [("7F FF", 200, 200), ("80 00", 200, 200), ("00 01", 200, -200), ("FF FF", -200, 200)],
)
def test_special_radii(started: Callable[..., FakeCreate], radius: str, right: int, left: int):
    robot = started()
    robot.receive_data(bytes([132]) + bytes.fromhex("89 00 C8" + radius), 0)
    values = ask(robot, 5)
    assert (values[41], values[42]) == (right, left)


def test_dropped_wheel_ends_safe_mode_silently(started: Callable[..., FakeCreate]):
    robot = started()
    robot.receive_data(bytes([131]), 0)
    robot.drop_wheel()
    assert ask(robot, 35) == {35: 1}
    assert ask(robot, 7) == {7: 0b1100}
    robot.receive_data(bytes([132]), 0)
    robot.drop_wheel()
    assert ask(robot, 35) == {35: 3}


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


def test_safe_mode_and_activity_keep_it_awake(started: Callable[..., FakeCreate]):
    robot = started()
    robot.receive_data(bytes([150, 1]), 200 * S)
    robot.due(499 * S)
    assert not robot.asleep
    robot.receive_data(bytes([131]), 499 * S)
    robot.due(5000 * S)
    assert not robot.asleep


def test_wired_wake_line_wakes_it_on_connecting():
    for wired in (False, True):
        robot = FakeCreate(STANDING, wakes_on_connect=wired)
        robot.receive_data(bytes([128, 133]), 0)
        robot.connected(1)
        assert robot.asleep is not wired


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


def test_reset_prints_the_banner_and_leaves_it_off(started: Callable[..., FakeCreate]):
    robot = started(Rolling(0.1, 0.1), start_counts=(40_000, 40_000))
    robot.receive_data(bytes([7]), S)
    assert run(robot, 3 * S) == [(S + 500 * MS, BANNER)]
    assert robot.mode is Mode.OFF
    robot.receive_data(bytes([128]), 3 * S)
    assert ask(robot, 43, 3 * S) == {43: math.floor(0.2 / M_PER_COUNT)}


def test_power_cut_does_so_even_to_one_asleep_or_in_the_middle_of_a_command(
    started: Callable[..., FakeCreate],
):
    robot = started(Rolling(0.1, 0.1), start_counts=(40_000, 40_000))
    robot.receive_data(bytes([133]), S)  # power: asleep
    robot.restart(2 * S)
    assert run(robot, 3 * S) == [(2 * S + 500 * MS, BANNER)]
    robot.receive_data(bytes([128, 148, 3, 43]), 3 * S)  # two of three packets
    robot.restart(4 * S)
    run(robot, 5 * S)
    robot.receive_data(bytes([128]), 5 * S)
    assert ask(robot, 43, 5 * S) == {43: math.floor(0.1 / M_PER_COUNT)}


def test_spoilt_checksum_is_noticed_and_what_has_none_stays(started: Callable[..., FakeCreate]):
    robot = started()
    robot.receive_data(encode_stream_request((35,)), 0)
    (_, frame), *_ = run(robot, 100 * MS)
    decoder = StreamDecoder((35,))
    assert decoder.receive_data(robot.spoil_checksum(frame) + frame) != []
    assert decoder.checksum_failures == 1
    assert robot.spoil_checksum(FLASH_TEXT) == FLASH_TEXT
    assert robot.spoil_checksum(b"\x13") == b"\x13"
    assert robot.spoil_checksum(b"") == b""


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
