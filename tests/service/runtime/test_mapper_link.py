"""The mapper's process and its stand-by: killed, hung, failing, and gone on with to the last bit."""

import logging
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.frames import NO_INTENSITY, Frame, LaserScan, OdometrySample
from service.deadline import HUNG_S, Deadline
from service.encoding import decode_pose, encode_frame
from service.geometry.se2 import SE2
from service.runtime import mapper_link, standstill
from service.runtime import mapper_messages as msg
from service.runtime.mapper_link import MapperLink, MapperLostError
from tests.processes import alive, is_there, look_at
from tests.service.runtime.mappers import FATAL_RANGE_M

pytestmark = pytest.mark.usefixtures("forked_mappers")
PERIOD_NS = 20_000_000
TIMEOUT_S = 30.0
CONNECTED = {"02", "03"}  # states of sockets in /proc/net/unix; 02: not accepted yet


class Heard:
    """MapperListener that keeps what it hears."""

    def __init__(self) -> None:
        self.messages: list[Any] = []
        self.takeovers: list[str] = []
        self.refusals: list[int] = []
        self.left_outs: list[int] = []

    def heard(self, message: Any) -> None:
        self.messages.append(message)

    def taken_over(self, words: str) -> None:
        self.takeovers.append(words)

    def refused(self, item: msg.FrameItem) -> None:
        self.refusals.append(item.number)

    def left_out(self, item: msg.FrameItem) -> None:
        self.left_outs.append(item.number)

    @property
    def graph_fault(self) -> str:
        return next((m.graph_fault for m in reversed(self.messages) if isinstance(m, msg.Status)), "")

    @property
    def poses(self) -> dict[int, bytes]:
        return {m.number: m.messages[0].payload for m in self.messages if isinstance(m, msg.Mapped)}


class Drive:
    """A link at work, fed with scans of a room driven through."""

    def __init__(self) -> None:
        self.heard = Heard()
        setup = msg.Setup({}, {"front": SE2()}, ("front",), frozenset(), 20.0, logging.WARNING)
        self.link = MapperLink(setup, self.heard)
        self.failure = ""
        self.thread = threading.Thread(target=self._run, daemon=True)
        self.scans = 0
        self.has_wheels = False

    def start(self) -> "Drive":
        self.link.start()
        self.thread.start()
        assert self.link.wait_ready(TIMEOUT_S)
        return self

    def scan(self, count: int = 1, fatal: bool = False) -> None:
        for _ in range(count):
            self.scans += 1
            stamp_ns = 10**9 + self.scans * PERIOD_NS
            arrived_ns = time.monotonic_ns() + 3600 * 10**9  # never too old, however slow this machine is
            if self.has_wheels:
                self._submit(_rolled(stamp_ns - 10, 0.01 * self.scans), arrived_ns)
            self._submit(_room(stamp_ns, 0.01 * self.scans, fatal), arrived_ns)

    def _submit(self, frame: Frame, arrived_ns: int) -> None:
        message, number = encode_frame(frame, 0, frame.stamp_ns), self.link.next_number()
        self.link.submit(
            msg.FrameItem(number, frame.stamp_ns, arrived_ns, frame.sensor, message.type, message.payload)
        )

    def switch(self, profile: str) -> list[msg.Answer]:
        """Where the answer will be."""
        answers: list[msg.Answer] = []
        number = self.link.next_number()
        self.link.submit(msg.SwitchItem(number, number, {"profile": profile}), answers.append)
        return answers

    def until(self, what: Callable[[], bool]) -> None:
        pause, deadline_s = threading.Event(), time.monotonic() + TIMEOUT_S
        while not what():
            assert time.monotonic() < deadline_s, (self.failure, self.heard.takeovers, self.link.waiting)
            pause.wait(0.01)

    def until_mapped(self) -> None:
        self.until(lambda: len(self.heard.poses) + len(self.heard.refusals) >= self.scans)

    def until_standby(self, number: int) -> None:
        self.until(lambda: self.link._standby is not None and self.link._standby[1].number >= number)

    def stop(self) -> None:
        self.link.close()
        if self.thread.ident is not None:
            self.thread.join(TIMEOUT_S)
            assert not self.thread.is_alive()
        self.link.clean_up()

    def _run(self) -> None:
        try:
            self.link.run()
        except MapperLostError as error:
            self.failure = str(error)


def _room(stamp_ns: int, x_m: float, fatal: bool) -> LaserScan:
    """271 beams in a room of 8 x 6 m, seen from x_m along its axis; one range says that it is fatal."""
    angle = np.deg2rad(np.arange(-135.0, 136.0))
    with np.errstate(divide="ignore"):
        to_x = np.where(np.cos(angle) > 0.0, 4.0 - x_m, 4.0 + x_m) / np.abs(np.cos(angle))
        to_y = 3.0 / np.abs(np.sin(angle))
    range_m = np.minimum(to_x, to_y).astype(np.float32)
    if fatal:
        range_m[0] = FATAL_RANGE_M
    times = (stamp_ns, stamp_ns, 0, PERIOD_NS)
    return LaserScan("front", *times, float(angle[0]), np.deg2rad(1.0), 0.05, 30.0, range_m, NO_INTENSITY)


def _rolled(stamp_ns: int, x_m: float) -> OdometrySample:
    return OdometrySample("base", stamp_ns, stamp_ns, x_m, 0.0, 0.0, (0.5, 0.0, 0.0), (0.0,) * 9)


@pytest.fixture
def drive() -> Iterator[Drive]:
    drive = Drive()
    yield drive
    drive.stop()


def test_a_mapper_that_is_killed_again_and_again_gives_the_poses_of_one_that_is_not(drive: Drive):
    undisturbed = Drive()
    undisturbed.has_wheels = drive.has_wheels = True
    try:
        undisturbed.start().scan(30)
        undisturbed.until_mapped()
    finally:
        undisturbed.stop()
    drive.start()
    for _ in range(3):
        drive.scan(7)
        pid = drive.link.pid
        os.kill(pid, signal.SIGKILL)
        drive.scan(3)
        drive.until_mapped()
        assert drive.link.pid != pid
    assert drive.heard.poses == undisturbed.heard.poses
    assert len(drive.heard.takeovers) == drive.link.restarts == 3
    numbers = [m.number for m in drive.heard.messages if isinstance(m, msg.Mapped)]
    assert numbers == sorted(set(numbers))  # nothing is reported twice


def folder_of(link: MapperLink) -> Path:
    """Where its sockets lie."""
    return link._mapper_socket.folder


def back_end_of(drive: Drive) -> int:
    """The process of its mapper's back end, once those of mappers before it have ended."""
    found: list[int] = []

    def is_alone() -> bool:
        found[:] = back_ends_of(drive.link.pid)
        return len(found) == 1

    drive.until(is_alone)
    return found[0]


def back_ends_of(mapper: int) -> list[int]:
    """Those that are not copies of another one for a stand-by."""
    parents = all_back_ends_of(mapper)
    return [pid for pid, parent in parents.items() if parent not in parents]


def has_back_end_for_standby(drive: Drive) -> bool:
    """Whether the copy of the back end that the newest stand-by goes on with has connected to it."""
    made = folder_of(drive.link).glob(f"back-end-{drive.link.pid}-*.sock")
    newest = max(made, key=lambda path: int(path.stem.rpartition("-")[2]), default=None)
    sockets = [line.split() for line in Path("/proc/net/unix").read_text().splitlines()]
    return any(fields[5] in CONNECTED and fields[-1] == str(newest) for fields in sockets)


def all_back_ends_of(mapper: int) -> dict[int, int]:
    """Process -> its parent. Back ends have a lower priority than the mapper."""
    its = look_at(mapper)
    return {
        one.pid: one.parent for one in alive() if one.session == its.session and one.niceness > its.niceness
    }


def test_a_back_end_that_dies_is_replaced_with_all_that_it_knew_until_it_dies_again_and_again(
    drive: Drive, strange: Callable[[str], None]
):
    strange("not at all")
    undisturbed = Drive()
    try:
        undisturbed.start().scan(40)
        undisturbed.until_mapped()
    finally:
        undisturbed.stop()
    drive.start()
    for deaths in range(1, mapper_link.MAX_BACK_END_DEATHS + 1):
        drive.scan(10)
        drive.until_mapped()
        pid = drive.link.pid
        back_end = back_end_of(drive)
        drive.until_standby(drive.scans)  # the next one is made when there is more to hold
        drive.until(lambda: has_back_end_for_standby(drive))
        os.kill(back_end, signal.SIGKILL)
        drive.until(lambda pid=pid: drive.link.pid not in (0, pid))
        assert len(drive.heard.takeovers) == deaths
        assert "without its graph: the back end's process died" in drive.heard.takeovers[-1]
    drive.scan(10)
    drive.until_mapped()
    assert drive.heard.poses == undisturbed.heard.poses
    assert not drive.heard.graph_fault
    os.kill(back_end_of(drive), signal.SIGKILL)  # once more: mapping goes on without it
    drive.scan(10)
    drive.until_mapped()
    assert len(drive.heard.takeovers) == mapper_link.MAX_BACK_END_DEATHS


@pytest.mark.parametrize("is_copied", [False, True])
def test_a_change_by_hand_is_made_and_answered_once_where_the_mapper_is_killed_before_its_result(
    drive: Drive, strange: Callable[[str], None], is_copied: bool
):
    """is_copied: the stand-by has taken the request, too."""
    strange("not at all")
    drive.start().scan(10)
    drive.until_mapped()
    answers: list[msg.Answer] = []
    for y_m in (0.5, 1.0):
        number = drive.link.next_number()
        wall = {"change": {"what": "wall", "corners": [[0.0, y_m], [1.0, y_m]]}}
        drive.link.submit(msg.GraphItem(number, number, "edit_map", wall), answers.append)
    if is_copied:
        drive.until_standby(number)
    os.kill(drive.link.pid, signal.SIGKILL)
    drive.until(lambda: len(drive.heard.takeovers) == 1)
    assert len(answers) < 2
    drive.until(lambda: drive.scan() or len(answers) == 2)
    assert [(answer.result.get("undoable"), answer.error) for answer in answers] == [(1, ""), (2, "")]
    assert not drive.heard.graph_fault


def test_a_new_stand_by_comes_by_itself(drive: Drive, strange: Callable[[str], None]):
    strange("not at all")
    drive.start().scan(20)
    drive.until_mapped()
    drive.until_standby(20)
    first = drive.link.standby_pid
    os.kill(first, signal.SIGKILL)
    drive.until(lambda: drive.link.standby_pid not in (0, first))
    assert not drive.heard.takeovers


def test_tiles_after_a_takeover_hold_the_whole_map(drive: Drive):
    drive.start().scan(10)
    drive.until_mapped()
    before = len(drive.heard.messages)
    os.kill(drive.link.pid, signal.SIGKILL)
    answers: list[msg.Answer] = []
    drive.scan(5)
    drive.link.submit(msg.TilesItem(drive.link.next_number(), 1), answers.append)
    drive.until(lambda: bool(answers))
    assert any(isinstance(m, msg.Tiles) for m in drive.heard.messages[before:])


def test_stand_bys_end_with_a_profile_that_has_none_and_come_back_with_one_that_has(drive: Drive):
    drive.start().scan(10)
    drive.until_mapped()
    drive.until_standby(10)
    to_imle = drive.switch("imle")
    drive.scan(10)
    drive.until(lambda: drive.link.standby_pid == 0)
    drive.scan(10)
    drive.until_mapped()
    assert to_imle[0].result is True
    back = drive.switch("contour_lm")
    drive.scan(10)
    drive.until_mapped()
    drive.until(lambda: drive.link.standby_pid != 0)
    assert back[0].result is True
    os.kill(drive.link.pid, signal.SIGKILL)
    drive.scan(10)
    drive.until_mapped()
    assert len(drive.heard.takeovers) == 1
    number = back[0].number
    assert 0.0 < x_m_of(drive, number + 20) - x_m_of(drive, number + 1) < 0.3  # one map all along


def x_m_of(drive: Drive, number: int) -> float:
    return decode_pose(drive.heard.poses[number]).pose.x_m


def test_a_frame_that_the_mapper_dies_of_is_left_out(drive: Drive, strange: Callable[[str], None]):
    strange("raises")
    drive.start().scan(5)
    drive.scan(fatal=True)
    drive.scan(5)
    drive.until_mapped()
    assert drive.heard.refusals == [6]
    assert sorted(drive.heard.poses) == [1, 2, 3, 4, 5, 7, 8, 9, 10, 11]
    assert "IndexError('no such tile')" in drive.heard.takeovers[0]


@pytest.mark.parametrize("how", ["hangs", "computes"])
def test_a_mapper_that_stands_still_or_computes_without_end_is_ended(
    drive: Drive, strange: Callable[[str], None], monkeypatch: pytest.MonkeyPatch, how: str
):
    """So does its stand-by at the same frame, and so on: then it is given up, aloud."""
    strange(how)
    drive.start().scan(3)
    drive.until_mapped()
    drive.until_standby(3)
    monkeypatch.setattr(standstill, "STILL_S", 0.3)
    drive.scan(fatal=True)
    drive.until(lambda: bool(drive.failure))
    assert "said nothing for" in drive.heard.takeovers[0]
    assert drive.failure.endswith("4 times after item 3")


def test_a_mapper_that_even_a_kill_does_not_end_is_left_behind(
    drive: Drive, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    """It waits for a disk that hangs, say."""
    drive.start().scan(3)
    drive.until_mapped()
    drive.until_standby(3)
    pid = drive.link.pid
    os.kill(pid, signal.SIGSTOP)
    monkeypatch.setattr(standstill, "STUCK_S", 0.8)
    monkeypatch.setattr(mapper_link, "END_S", 0.1)
    monkeypatch.setattr(os, "killpg", lambda group, number: None)
    monkeypatch.setattr(mapper_link, "_kill", lambda pid: None)
    try:
        drive.scan(5)
        drive.until_mapped()
        drive.link.close()
        drive.thread.join(TIMEOUT_S)
        drive.link.clean_up()
    finally:
        os.kill(pid, signal.SIGKILL)
    assert (len(drive.heard.poses), len(drive.heard.takeovers)) == (8, 1)
    assert f"the mapper's process ({pid}) was killed and has not ended within 0.1 s" in caplog.text


def test_a_mapper_that_does_not_start_is_reported(strange: Callable[[str], None]):
    strange("does not compile")
    drive = Drive()
    try:
        drive.link.start()
        drive.thread.start()
        drive.until(lambda: bool(drive.failure))
        assert "before it was ready" in drive.failure
    finally:
        drive.stop()


def test_a_process_that_has_ended_is_killed_once_and_not_again(drive: Drive, monkeypatch: pytest.MonkeyPatch):
    """By then its number may be that of another process."""
    killed: list[int] = []
    kill = mapper_link._kill

    def note_and_kill(pid: int) -> None:
        killed.append(pid)
        kill(pid)

    monkeypatch.setattr(mapper_link, "_kill", note_and_kill)
    drive.start().scan(3)
    drive.until_mapped()
    first = drive.link.pid
    os.kill(first, signal.SIGKILL)
    drive.until(lambda: drive.link.pid not in (0, first))
    second = drive.link.pid
    assert drive.link.finish(Deadline())
    drive.until(lambda: drive.link.pid == 0)
    drive.stop()
    assert [pid for pid in killed if pid] == [first, second]


@pytest.mark.parametrize("is_stopped", [False, True])
def test_everything_ends_with_the_link(drive: Drive, is_stopped: bool):
    drive.start().scan(3)
    drive.until_mapped()
    drive.until(lambda: drive.link.standby_pid != 0)
    pids = [one.pid for one in alive() if one.session == drive.link.pid]
    assert len(pids) >= 4  # mapper and stand-by, each with a back end
    folder = folder_of(drive.link)
    for pid in pids if is_stopped else []:
        os.kill(pid, signal.SIGSTOP)
    deadline = Deadline()
    assert drive.link.finish(deadline)  # the end of a stopped mapper wakes its stand-by
    assert (deadline.left_s <= HUNG_S) is is_stopped  # else it would be most of a minute
    drive.stop()
    for pid in pids:
        drive.until(lambda pid=pid: not is_there(pid))
    assert not folder.exists()


def test_a_back_end_that_stands_still_shortens_the_end(drive: Drive):
    drive.start().scan(3)
    drive.until_mapped()
    drive.until(lambda: drive.link.standby_pid != 0)
    for one in alive():
        if one.parent == drive.link.pid and one.pid != drive.link.standby_pid:
            os.kill(one.pid, signal.SIGSTOP)
    deadline = Deadline()
    assert drive.link.finish(deadline)
    assert "it stands still" in drive.heard.graph_fault
    assert deadline.left_s <= HUNG_S
