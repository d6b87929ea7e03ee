"""The process beside the mapper's in which a graph's back end does its work.

A process of its own, because the solver holds the interpreter while it works. It is forked from the mapper's,
has no threads, and can be forked itself: a stand-by of the mapper gets a stand-by of the back end.
"""

import ctypes
import gc
import logging
import math
import os
import signal
import socket
import struct
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from service.interruption import wake_when_parent_ends
from service.mapper.background import BackEnd, BackEndDiedError, WorkLostError
from service.runtime.channel import Channel, ChannelClosedError, End, Listening, wait_for
from service.runtime.standstill import Standstill

log = logging.getLogger(__name__)

NICENESS = 5  # a loop may close a little later; scans may not wait
STOP_S = 2.0
WAIT_S = 0.2
MEET_S = 1.0  # that a stand-by which takes over waits for its back end: only then it can be copied itself
STILL_S = 2.0  # a back end that someone waits for, and that neither computes nor waits for a processor
OWN_MAPPING_BYTES = 256 * 1024  # of an allocation that goes back to the system when it is freed
M_MMAP_THRESHOLD = -3  # of mallopt(3)
MAX_SENT = 2  # batches without an answer that the process has got: a copy is made after them
CONNECT_S = 20.0  # that a copy may take to reach its stand-by once the process that makes it is gone or still


class _Work(NamedTuple):
    number: int
    batch: Any


class _Copy(NamedTuple):
    """Fork; the copy serves the stand-by that listens at the path."""

    path: str
    answered: int  # answers up to this one have come


class _Done(NamedTuple):
    number: int
    answer: Any


class _Failed(NamedTuple):
    words: str


class BackEndProcess:
    """Does the work of one back end after the other; waits for nothing but `result`. Needs no thread.

    Each back end gets a process that is forked from this one, so it comes there whatever its size: what a
    vehicle looks for itself in is 280 MB for an office. A profile without a graph has none. The process
    before ends once it has finished its request. When one dies where nothing can replace it, that is logged
    once, and all work from then on is lost; it ends when this process ends, however it ends.

    is_waiting       called several times a second while result() waits
    patience_s       how long result() of all its work may keep others waiting, taken together
    is_replaceable   whether a copy of this process could go on with a copy of the back end. Then every call
                     but `stop` raises BackEndDiedError when it dies
    """

    def __init__(
        self,
        patience_s: float,
        is_replaceable: Callable[[], bool] = lambda: False,
        is_waiting: Callable[[], None] = lambda: None,
    ) -> None:
        self.patience_s = self._left_s = patience_s
        self._is_replaceable = is_replaceable
        self._is_waiting = is_waiting
        self._channel: Channel | None = None
        self._former: list[Channel] = []  # of processes before, which have not taken all that they were sent
        self._listener: socket.socket | None = None  # of a stand-by, until its back end has come
        self._expected_by_s = math.inf  # host monotonic; until then it may come
        self._still = Standstill()  # of the process that makes it
        self._is_spare = False  # of a stand-by that is not needed yet: it would do the same work again
        self._unsent: deque[_Work] = deque()  # beyond MAX_SENT, or while it is spare or awaited
        self._submitted = 0
        self._submitted_s: dict[int, float] = {}  # when the batches without an answer were, host monotonic
        self._answers: dict[int, Any] = {}
        self._answered = 0
        self._unwanted = 0  # answers up to this number are not awaited
        self.pid: int | None = None  # of the process; None where there is none, or it is another's child
        self._worker_pid = 0  # of the process that has the back end
        self.fault = ""  # why it has ended, "" while it works
        self.stood_still = False  # whether result() gave it up for that

    @property
    def ends(self) -> list[End]:
        """Ends for `wait_for`; then call `look`."""
        if self._channel is not None:
            return [self._channel]
        return [] if self._listener is None else [Listening(self._listener)]

    @property
    def is_awaited(self) -> bool:
        """Whether this process is of a stand-by whose back end has not come yet: it cannot be copied."""
        return self._connected() is None and self._listener is not None

    def need(self) -> None:
        """The stand-by has taken over: its back end has to come, and mostly is there."""
        self._is_spare = False
        self._expected_by_s = time.monotonic() + CONNECT_S
        self._connected(MEET_S)

    @property
    def behind_s(self) -> float:
        """For how long the oldest batch without an answer has waited."""
        return time.monotonic() - next(iter(self._submitted_s.values())) if self._submitted_s else 0.0

    def look(self) -> None:
        """Receive its messages, which also show that it lives."""
        self._receive(0.0)

    def new_worker(self, back_end: BackEnd) -> "ProcessWorker":
        self._unwanted = self._answered = self._submitted
        self._answers.clear()
        self._submitted_s.clear()
        if not self.fault:
            self._leave()
            self._begin(back_end)
        return ProcessWorker(self)

    def stop(self) -> None:
        """End the process at once; open work is lost."""
        if self._channel is not None:
            self._channel.close()
            self._channel = None
        if self._listener is not None:
            self._close_listener()
        if self.pid is not None:
            _kill(self.pid)
            self.pid = None
        self.fault = self.fault or "the back end has been stopped"

    def copy(self, path: Path) -> None:
        """Before a fork of this process: have the back end fork, too; its copy will come to `path`. Not while
        it is awaited itself.
        """
        if self._connected() is None:
            return
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._listener.setblocking(False)
        self._listener.bind(str(path))
        self._listener.listen(1)
        self._send(_Copy(str(path), self._answered))
        if self.fault:
            self._close_listener()

    def forked(self, is_copy: bool) -> None:
        """After the fork: the copy uses the copied back end; in the parent nothing changes."""
        if is_copy:
            for channel in self._former:
                channel.close()
            self._former.clear()
        if self._listener is None:
            return
        if is_copy:
            if self._channel is not None:
                self._channel.close()
            self._channel, self.pid = None, None
            self._is_spare = True
        else:
            self._close_listener()

    def submit(self, batch: Any) -> int:
        """Number of the work."""
        self._submitted += 1
        if not self.fault:
            self._submitted_s[self._submitted] = time.monotonic()
            self._unsent.append(_Work(self._submitted, batch))
            self._send_waiting()
        return self._submitted

    def is_ready(self, number: int) -> bool:
        """Whether `result` answers at once, be it with an error."""
        if number > self._answered and not self.fault:
            self._receive(0.0)
        return number <= self._answered or bool(self.fault)

    def result(self, number: int) -> Any:
        """Raises WorkLostError."""
        began_s = time.monotonic()
        standstill = Standstill()
        still_s = 0.0
        while (
            not self.is_ready(number)
            and still_s < STILL_S
            and (left_s := self._left_s - (time.monotonic() - began_s)) > 0.0
        ):
            self._receive(min(left_s, WAIT_S))
            still_s = standstill.seconds(self._worker_pid)[0] if self._worker_pid else 0.0
            self._is_waiting()
        self._left_s = max(self._left_s - (time.monotonic() - began_s), 0.0)
        if number in self._answers:
            return self._answers.pop(number)
        if self.fault:
            raise WorkLostError(self.fault)
        took_s = time.monotonic() - began_s
        self.stood_still = still_s >= STILL_S
        late = f"the back end did not finish within {took_s:.1f} s{', it stands still' * self.stood_still}"
        log.error("%s; what it found last is lost, and the map keeps the graph of the last checkpoint", late)
        raise WorkLostError(late)

    def _leave(self) -> None:
        """Stop sending to the process. A requested copy stays in use."""
        if self._listener is not None:
            self._close_listener()
        self._unsent.clear()
        if self._channel is not None:
            self._former.append(self._channel)
            self._channel = None
        self._flush_former()

    def _flush_former(self) -> None:
        for channel in self._former[:]:
            try:
                is_over = channel.flush()
            except ChannelClosedError:
                is_over = True
            if is_over:
                channel.close()
                self._former.remove(channel)

    def _begin(self, back_end: BackEnd) -> None:
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
        pid = os.fork()
        if pid == 0:
            _live(theirs, back_end)
        theirs.close()
        self.pid, self._channel = pid, Channel(ours)
        self._worker_pid = pid

    def _connected(self, timeout_s: float = 0.0) -> Channel | None:
        """The channel; the back end of a stand-by that has not come yet may do so within timeout_s."""
        if self._channel is None and self._listener is not None:
            if wait_for([Listening(self._listener)], timeout_s):
                connection = self._listener.accept()[0]
                self._channel, self._worker_pid = Channel(connection), _peer_pid(connection)
                self._close_listener()
            elif math.isfinite(self._expected_by_s) and not self._is_expected():
                self._close_listener()
                self._give_up(f"the back end of the stand-by did not come within {CONNECT_S:g} s")
        return self._channel

    def _is_expected(self) -> bool:
        """Whether the copy may still come: the process that makes it first ends the work that it has got."""
        now_s = time.monotonic()
        if self._still.seconds(self._worker_pid)[0] == 0.0:
            self._expected_by_s = now_s + CONNECT_S
        return now_s <= self._expected_by_s

    def _close_listener(self) -> None:
        assert self._listener is not None
        self._listener.close()
        self._listener = None

    def _send_waiting(self) -> None:
        if self._is_spare or self._connected() is None:
            return
        while self._unsent and self._unsent[0].number - self._answered <= MAX_SENT:
            self._send(self._unsent.popleft())

    def _send(self, message: _Work | _Copy) -> None:
        assert self._channel is not None
        try:
            self._channel.send(message)
        except ChannelClosedError as error:
            self._died(error)

    def _receive(self, timeout_s: float) -> None:
        self._flush_former()
        channel = self._connected(timeout_s)
        if channel is None:
            return
        try:
            channel.flush()
            for message in channel.receive_within(timeout_s) if timeout_s > 0.0 else channel.receive():
                if isinstance(message, _Failed):
                    self._give_up(f"the back end failed: {message.words}")
                    continue
                self._answered = message.number
                self._submitted_s.pop(message.number, None)
                if message.number > self._unwanted:
                    self._answers[message.number] = message.answer
            self._send_waiting()
        except ChannelClosedError as error:
            self._died(error)

    def _died(self, error: ChannelClosedError) -> None:
        fault = f"the back end's process died ({error})"
        if not self.fault and self._is_replaceable():
            self._shut(fault)
            raise BackEndDiedError(fault) from error
        self._give_up(fault)

    def _give_up(self, fault: str) -> None:
        if not self.fault:
            log.error("%s; mapping goes on without closing loops", fault)
        self._shut(fault)

    def _shut(self, fault: str) -> None:
        if self._channel is not None:
            self._channel.close()
            self._channel = None
        self._unsent.clear()
        self._submitted_s.clear()
        self.fault = self.fault or fault


class ProcessWorker:
    """Worker of one back end in the process."""

    def __init__(self, process: BackEndProcess) -> None:
        self._process = process

    def submit(self, batch: Any) -> "ProcessJob":
        return ProcessJob(self._process, self._process.submit(batch))

    def close(self) -> None: ...


class ProcessJob:
    """A Job of the process."""

    def __init__(self, process: BackEndProcess, number: int) -> None:
        self._process = process
        self._number = number

    @property
    def ready(self) -> bool:
        return self._process.is_ready(self._number)

    def result(self) -> Any:
        return self._process.result(self._number)


def _peer_pid(connection: socket.socket) -> int:
    credentials = struct.Struct("3i")  # pid, uid, gid
    pid, _, _ = credentials.unpack(
        connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, credentials.size)
    )
    return int(pid)


def _kill(pid: int) -> None:
    try:
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)
    except (ProcessLookupError, ChildProcessError):
        return  # it has ended, and the system has taken it away


def _live(connection: socket.socket, back_end: BackEnd) -> None:
    """The process, from its fork to its end: when the other side is gone."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGCHLD):
        signal.signal(number, signal.SIG_IGN)  # signals to the service end it too; copies need not be reaped
    wake_when_parent_ends()
    # Else a process that waits for the mapper to end would wait for this process, too.
    os.closerange(3, connection.fileno())
    os.closerange(connection.fileno() + 1, os.sysconf("SC_OPEN_MAX"))
    gc.unfreeze()
    os.nice(NICENESS)
    return_freed_memory()
    try:
        _Server(Channel(connection), back_end).run()
    except ChannelClosedError:
        pass
    finally:
        os._exit(0)  # nothing of the process that it was forked from is cleaned up twice


def return_freed_memory() -> None:
    """Return the memory of arrays to the system when they are freed.

    The C library raises its threshold to the largest block that was freed; from then on sub-maps lie on the
    heap between smaller blocks, and hours of laps take ever more memory. Without mallopt nothing is changed.
    """
    if mallopt := getattr(ctypes.CDLL(None), "mallopt", None):
        mallopt(M_MMAP_THRESHOLD, OWN_MAPPING_BYTES)


class _Server:
    def __init__(self, channel: Channel, back_end: BackEnd) -> None:
        self._channel = channel
        self._back_end = back_end
        self._kept: list[_Done] = []  # answers since the last copy: one of the next may still need them

    def run(self) -> None:
        while True:
            channel = self._channel
            for message in channel.receive_within(3600.0):
                self._take(message)
                if self._channel is not channel:
                    break  # this is the copy: what came behind is for the one that it was made of

    def _take(self, message: Any) -> None:
        if isinstance(message, _Copy):
            self._kept = [done for done in self._kept if done.number > message.answered]
            if os.fork() == 0:
                self._move_to(message.path)
        else:
            try:
                done = _Done(message.number, self._back_end.work(message.batch))
            except Exception as error:  # after any exception the state of the back end is unknown
                self._channel.send(_Failed(f"{type(error).__name__}: {error}"))
                self._channel.receive_within(STOP_S)
                raise ChannelClosedError("failed") from error
            self._kept.append(done)
            with suppress(ChannelClosedError):  # the mapper has died; a copy that it requested may be waiting
                self._channel.send(done)

    def _move_to(self, path: str) -> None:
        """In the copy: serve the stand-by at the path from now on."""
        wake_when_parent_ends()
        self._channel.close()
        connection = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            connection.connect(path)
        except OSError:
            os._exit(0)  # the stand-by has ended already
        self._channel = Channel(connection)
        for done in self._kept:
            self._channel.send(done)
