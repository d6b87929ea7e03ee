from service.encoding import IMU, LASER_SCAN
from service.runtime.backlog import MAX_AHEAD, MAX_WAITING, Backlog
from service.runtime.mapper_messages import FrameItem

SCAN, SAMPLE = (FrameItem(1, 1, 1, "any", name, b"") for name in (LASER_SCAN, IMU))


def taken(backlog: Backlog, waiting: int) -> list[FrameItem]:
    return [frame for frame in (SCAN, SAMPLE) if backlog.takes(frame, waiting)]


def test_a_scan_that_would_be_too_old_in_its_turn_is_left_out():
    backlog = Backlog()
    waiting = (MAX_AHEAD - 1, MAX_AHEAD, MAX_AHEAD - 1)
    assert [taken(backlog, count) for count in waiting] == [[SCAN, SAMPLE], [SAMPLE], [SCAN, SAMPLE]]


def test_a_full_backlog_takes_nothing_until_it_is_worked_off():
    backlog = Backlog()
    waiting = (MAX_WAITING - 1, MAX_WAITING, MAX_WAITING - 1, MAX_AHEAD + 1, MAX_AHEAD, MAX_WAITING - 1)
    assert [taken(backlog, count) for count in waiting] == [[SAMPLE], [], [], [], [SAMPLE], [SAMPLE]]
