from drivers.irobot_create.protocol import Mode, Opcode, decode_values, encode_stream_request
from simulators.irobot_create import FakeCreate
from tests.drivers.irobot_bench import STANDING, S


def test_it_sleeps_after_five_minutes_of_passive_and_only_the_wake_line_helps():
    robot = FakeCreate(STANDING)
    robot.receive_data(bytes([128]), 0)
    robot.receive_data(encode_stream_request([35]), 0)
    robot.due(299 * S)
    assert robot.next_due_ns(299 * S) is not None
    assert robot.due(300 * S) == b""
    assert robot.asleep
    assert robot.receive_data(bytes([128, 142, 35]), 301 * S) == b""
    robot.wake(302 * S)
    assert robot.receive_data(bytes([128, 142, 35]), 303 * S) == b"\x01"


def test_pycreate2_dialogue():
    """What pycreate2 0.8 sends: start, safe, four songs cleared, group 100, drive direct, and its close."""
    robot = FakeCreate(STANDING)
    assert robot.receive_data(bytes([131, 142, 100, 148, 1, 7]), 0) == b""  # ignored until Start
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
