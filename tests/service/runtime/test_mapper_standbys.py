"""Which stand-by goes on, where several come late or out of order: mappers that are only their messages."""

import logging
import socket
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, ClassVar

import pytest

from service.encoding import IMU, LASER_SCAN, ODOMETRY
from service.geometry.se2 import SE2
from service.runtime import backlog, mapper_link
from service.runtime import mapper_messages as msg
from service.runtime.channel import Channel, ChannelClosedError
from service.runtime.mapper_link import MapperLink
from tests.in_background import started
from tests.service.runtime.test_mapper_link import Heard, folder_of
from tests.waiting import wait_until

TIMEOUT_S = 10.0
FIRST, SECOND, LATE, THIRD = -2, -3, -4, -5  # process ids that no one has and no one kills


class Acted:
    """A mapper or a stand-by, played by the test."""

    opened: ClassVar[list[Channel]] = []  # closed with the link

    def __init__(self, path: Path) -> None:
        self.connection = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self.connection.connect(str(path / "mapper.sock"))
        self.channel = Channel(self.connection)
        self.opened.append(self.channel)
        self.heard: list[Any] = []

    def say(self, message: Any) -> "Acted":
        self.channel.send(message)
        return self

    def until(self, count: int) -> list[Any]:
        """The first so many messages to it."""
        while len(self.heard) < count:
            received = self.channel.receive_within(TIMEOUT_S)
            assert received, f"{len(self.heard)} messages in {TIMEOUT_S} s, expected {count}"
            self.heard += received
        return self.heard

    def numbers(self) -> list[int]:
        return [message.number for message in self.heard if isinstance(message, msg.Item)]


@pytest.fixture
def heard() -> Heard:
    return Heard()


@pytest.fixture
def link(heard: Heard) -> Iterator[MapperLink]:
    setup = msg.Setup({}, {"front": SE2()}, ("front",), frozenset(), 20.0, logging.WARNING)
    link = MapperLink(setup, heard)
    running = started(link.run)
    yield link
    link.close()
    running.result(TIMEOUT_S)
    link.clean_up()
    while Acted.opened:
        Acted.opened.pop().close()


def submit(link: MapperLink, count: int) -> None:
    for _ in range(count):
        number = link.next_number()
        link.submit(msg.TilesItem(number, number))


def first_mapper(link: MapperLink) -> Acted:
    mapper = Acted(folder_of(link)).say(msg.Hello(FIRST, 0, is_standby=False))
    mapper.until(1)  # the set-up
    mapper.say(msg.Ready(has_standby=True))
    assert link.wait_ready(TIMEOUT_S)
    return mapper


def standby(link: MapperLink, pid: int, number: int, of_pid: int) -> Acted:
    return Acted(folder_of(link)).say(msg.Hello(pid, number, is_standby=True, of_pid=of_pid))


def until_standby(link: MapperLink, pid: int) -> None:
    wait_until(lambda: link.standby_pid == pid, words=f"the stand-by is not {pid}")


def is_sent_away(acted: Acted) -> bool:
    try:
        acted.channel.receive_within(TIMEOUT_S)
    except ChannelClosedError:
        return True
    return False


def test_a_copy_of_a_lost_mapper_that_is_being_made_still_goes_on(link: MapperLink):
    mapper = first_mapper(link)
    submit(link, 3)
    assert link.pid == FIRST
    mapper.channel.close()
    wait_until(lambda: link.pid == 0, words="the lost mapper has a number still")
    second = standby(link, SECOND, 1, of_pid=FIRST)
    second.until(3)
    assert second.numbers() == [2, 3]
    assert link.pid == SECOND


def test_samples_that_wait_for_a_scan_wait_for_the_stand_by_too(
    link: MapperLink, monkeypatch: pytest.MonkeyPatch
):
    """No mapper is there to send them to when they have waited long enough."""
    monkeypatch.setattr(mapper_link, "HOLD_NS", 10**18)
    mapper = first_mapper(link)
    link.submit(msg.FrameItem(1, 1, time.monotonic_ns(), "base", ODOMETRY, b""))
    mapper.channel.close()
    wait_until(lambda: link.pid == 0, words="the lost mapper has a number still")
    monkeypatch.setattr(mapper_link, "HOLD_NS", 0)
    turns = link.turns
    wait_until(lambda: link.turns > turns + 1, words="the link stands still")
    second = standby(link, SECOND, 0, of_pid=FIRST)
    second.until(2)
    assert second.numbers() == [1]


def test_a_copy_that_a_newer_one_has_overtaken_is_sent_away(link: MapperLink):
    mapper = first_mapper(link)
    submit(link, 5)
    mapper.until(6)
    newer = standby(link, SECOND, 4, of_pid=FIRST)
    until_standby(link, SECOND)
    newer.channel.close()
    mapper.until(7)
    assert isinstance(mapper.heard[-1], msg.MakeStandby)  # it is heard that the newer one is gone
    assert is_sent_away(standby(link, LATE, 2, of_pid=FIRST))
    assert link.standby_pid == 0


def test_the_connection_to_a_mapper_that_takes_nothing_any_more_is_closed(link: MapperLink):
    first = first_mapper(link)
    second = standby(link, SECOND, 0, of_pid=FIRST)
    until_standby(link, SECOND)
    first.connection.shutdown(socket.SHUT_RD)
    submit(link, 1)
    second.until(2)
    assert second.numbers() == [1]
    with pytest.raises(ChannelClosedError):
        first.say(msg.Ready(has_standby=True))


def test_samples_go_with_the_next_scan_and_soon_without_one(link: MapperLink):
    mapper = first_mapper(link)
    later_ns = time.monotonic_ns() + 3600 * 10**9  # none has waited, however slow this machine is

    def submit_one(number: int, type_name: str, arrived_ms: int) -> list[int]:
        """Numbers of the items that go out by that."""
        arrived_ns = later_ns + arrived_ms * 1_000_000
        link.submit(msg.FrameItem(number, number, arrived_ns, "any", type_name, b""))
        return [item.number for item in mapper.channel.receive()]

    sent = [submit_one(1, ODOMETRY, 0), submit_one(2, IMU, 5), submit_one(3, LASER_SCAN, 10)]
    assert sent == [[], [], [1, 2, 3]]
    assert [submit_one(4, IMU, 20), submit_one(5, IMU, 45), submit_one(6, IMU, 46)] == [[], [], [4, 5, 6]]


def test_scans_of_a_mapper_that_is_behind_are_left_out_and_samples_are_not(
    link: MapperLink, heard: Heard, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(backlog, "MAX_AHEAD", 3)
    mapper = first_mapper(link)

    def submit_one(type_name: str) -> int:
        number = link.next_number()
        link.submit(msg.FrameItem(number, number, 0, "any", type_name, b""))
        return number

    assert [submit_one(name) for name in (LASER_SCAN, IMU, LASER_SCAN)] == [1, 2, 3]
    assert [submit_one(name) for name in (LASER_SCAN, ODOMETRY, LASER_SCAN)] == [4, 4, 5]
    mapper.say(msg.Status(2))
    wait_until(lambda: link.waiting == 2, words="what the mapper has taken is not known")
    assert submit_one(LASER_SCAN) == 5
    mapper.until(6)
    assert [(item.number, item.type) for item in mapper.heard[1:]] == [
        *((1, LASER_SCAN), (2, IMU), (3, LASER_SCAN), (4, ODOMETRY), (5, LASER_SCAN))
    ]
    assert heard.left_outs == [4, 5]


def test_a_copy_that_would_need_items_from_before_they_were_kept_again_is_sent_away(link: MapperLink):
    """A profile without stand-bys has mapped for a while: its items are not kept."""
    mapper = first_mapper(link)
    submit(link, 2)
    mapper.until(3)
    before = standby(link, SECOND, 1, of_pid=FIRST)
    until_standby(link, SECOND)
    mapper.say(msg.CanCopy(False))
    assert is_sent_away(before)  # it knows nothing of the other profile
    submit(link, 3)
    mapper.until(6)
    submit(link, 5)
    mapper.until(11)
    mapper.say(msg.CanCopy(True))
    turns = link.turns
    wait_until(lambda: link.turns > turns + 1, words="the link stands still")
    late = standby(link, LATE, 9, of_pid=FIRST)
    assert is_sent_away(late)
    submit(link, 2)
    third = standby(link, THIRD, 10, of_pid=FIRST)
    until_standby(link, THIRD)
    mapper.channel.close()
    third.until(3)
    assert third.numbers() == [11, 12]
