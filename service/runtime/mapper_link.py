"""Ingest's side of the mapper's process: starts it, exchanges messages, replaces it by a stand-by.

    readers --submit--> socket --> mapper's process --> socket --> thread here --> recorder, publisher, tiles

Nothing here makes a reader wait: what the mapper does not take at once waits in the channel. Samples go with
the next scan: without one nothing comes of them, and each wake-up of the mapper takes processor time from a
scan. A thread of its own listens. When the mapper dies, or stands still, the newest stand-by gets the items
after its own last one again, which are kept here until a newer stand-by has them.
"""

import logging
import os
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from typing import Any, Protocol

from service.deadline import SAVE_S, Deadline
from service.runtime import mapper_messages as msg
from service.runtime.backlog import Backlog
from service.runtime.channel import Channel, ChannelClosedError, Listening, wait_for
from service.runtime.early_mapper import END_S, MODULE, EarlyMapper, MapperSocket, mapper_environment
from service.runtime.standstill import STILL_S, MapperSilence

log = logging.getLogger(__name__)

LISTEN_S = 0.2
MAX_DEATHS = 4  # without an item done in between: then the service ends with an error
HOLD_NS = 25_000_000  # that a sample may wait for the scan that it goes to the mapper with
MAX_DELAYED = 64  # samples; then they go without one
MAX_BACK_END_DEATHS, BACK_END_DEATHS_WITHIN_S = 3, 60.0  # then the stand-by stays where its own one dies
STANDBY_S = 5.0  # that a stand-by which has just been made may take to come here


class MapperListener(Protocol):
    """Receiver of the mapper's messages; all calls come from one thread."""

    def heard(self, message: msg.Heard) -> None: ...

    def taken_over(self, words: str) -> None:
        """A stand-by has replaced the mapper; tiles that come now count again."""

    def refused(self, item: msg.FrameItem) -> None:
        """This frame is left out from now on: the mapper died at it."""

    def left_out(self, item: msg.FrameItem) -> None:
        """This frame is not mapped: too many items wait. From the thread of a reader."""


class MapperLostError(Exception):
    """The mapper dies again and again."""


class MapperLink:
    """`start` the process, `submit` items, have a thread `run`; at last `finish`, `close`, `clean_up`."""

    def __init__(self, setup: msg.Setup, listener: MapperListener, early: EarlyMapper | None = None) -> None:
        """early: a process that has been begun, and given the section of the config that `setup` holds."""
        self._setup = setup
        self._listener = listener
        self._early = early
        self._mapper_socket = MapperSocket() if early is None else early.mapper_socket
        self._lock = threading.Lock()  # of what follows, down to the blank line
        self._active: Channel | None = None
        self._given_up: list[Channel] = []  # replaced ones, until they are closed
        self._kept: deque[msg.Item] = deque()  # those after the stand-by's last
        self._keeps_items = True  # as long as there may be a stand-by that needs them
        self._delayed: list[msg.FrameItem] = []  # samples that go with the next scan
        self._number = 0  # of the last item submitted
        self._backlog = Backlog()
        self._answers: dict[int, Callable[[msg.Answer], None]] = {}

        self._process: subprocess.Popen[bytes] | None = None
        self._pid = 0  # of the active mapper; 0 once it is killed: another process may get its number
        self._last_pid = 0  # of the active mapper, or of the one before: copies of it are welcome
        self._unidentified: list[Channel] = []  # connected, and have not named themselves
        self._standby: tuple[Channel, msg.Hello] | None = None
        self._done_number = 0
        self._forgotten_number = 0  # items up to here are not kept any more
        self._applied: dict[int, int] = {}
        self._passed_over: set[int] = set()
        self._refused: set[int] = set()
        self._silence = MapperSilence()
        self._taken_number = 0  # as the mapper reported last
        self._deaths = (0, 0)  # how many since the item that was done last
        self._back_ends_died_s: deque[float] = deque(maxlen=MAX_BACK_END_DEATHS)  # host monotonic
        self._orphaned: tuple[str, float] | None = None  # why there is no mapper, and since when
        self._deadline: Deadline | None = None  # once it is finishing
        self._finished = threading.Event()
        self._ready = threading.Event()
        self._closed = threading.Event()
        self._over = threading.Event()  # nothing receives any more
        self.kernels_share = 0.0
        self.kernels = ""  # how far the compiling of kernels is, as text; "" before the first
        self.restarts = 0
        self.turns = 0  # rises as long as `run` turns, with or without items

    @property
    def pid(self) -> int:
        """Process id of the mapper; 0 while there is none."""
        return self._pid

    @property
    def standby_pid(self) -> int:
        """Process id of the stand-by; 0 while there is none."""
        return self._standby[1].pid if self._standby is not None else 0

    @property
    def waiting(self) -> int:
        """Items that the mapper has not taken yet, as far as it has reported."""
        return self._number - self._taken_number

    @property
    def silent_s(self) -> float:
        """For how long the mapper has sent nothing; it sends its status several times a second."""
        return self._silence.seconds

    def wait_ready(self, timeout_s: float) -> bool:
        """Whether kernels are there and frames are mapped."""
        return self._ready.wait(timeout_s)

    def start(self) -> None:
        """Start the process; it is ready when `wait_ready` says so. `run` must turn meanwhile."""
        self._silence.begin()
        if self._early is not None:
            self._process = self._early.process
            return
        command = [sys.executable, "-m", MODULE, str(self._mapper_socket.folder)]
        # A session of its own: Ctrl-C is for ingest, which decides when it ends.
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, env=mapper_environment(), start_new_session=True
        )

    def next_number(self) -> int:
        """Number of the next item."""
        return self._number + 1

    def submit(self, item: msg.Item, answered: Callable[[msg.Answer], None] | None = None) -> None:
        """Hand over the next item, never waiting; `answered` hears, in the thread of `run`, its outcome.

        A frame for which too many items wait is left out, and the next item takes its number.
        """
        with self._lock:
            if isinstance(item, msg.FrameItem) and not self._backlog.takes(item, self.waiting):
                self._listener.left_out(item)
                return
            self._number = item.number
            if self._keeps_items:
                self._kept.append(item)
            if answered is not None:
                self._answers[item.number] = answered
            if self._active is None or not self._ready.is_set():
                return
            if msg.is_sample(item):
                self._delayed.append(item)
                if (
                    item.arrived_ns - self._delayed[0].arrived_ns > HOLD_NS
                    or len(self._delayed) > MAX_DELAYED
                ):
                    self._send_delayed()
            else:
                self._send_delayed(item)

    def run(self) -> None:
        """Receive messages until `close`. Raises MapperLostError."""
        try:
            while not self._closed.is_set():
                self.turns += 1
                with suppress(ChannelClosedError):  # whose end that is shows when it is read
                    self._listen()
                self._watch()
        finally:
            self._over.set()

    def finish(self, deadline: Deadline) -> bool:
        """After the last item: have the graph finish and the last tiles handed over.

        False if that is not done SAVE_S before the deadline, was never begun, or the mapper is lost for good.
        """
        if not self._ready.is_set():
            return False
        with self._lock:
            self._deadline = deadline
            if self._active is not None:
                self._send_delayed(msg.Finish())
        while deadline.left_s > SAVE_S and not self._over.is_set() and not self._finished.wait(LISTEN_S):
            pass
        return self._finished.is_set()

    def _send_delayed(self, *messages: Any) -> None:
        delayed, self._delayed = self._delayed, []
        self._send(*delayed, *messages)

    def _send(self, *messages: Any) -> None:
        """Under the lock, to the active mapper. One that is gone is left to the thread of `run`."""
        assert self._active is not None
        try:
            self._active.send(*messages)
        except ChannelClosedError:
            self._given_up.append(self._active)  # open still: that thread may be waiting for it
            self._active = None

    def close(self) -> None:
        """End the process and its stand-by at once; `run` returns."""
        self._closed.set()

    def clean_up(self) -> None:
        """Call it when `run` has returned. Raises nothing: recording and map are finished after it."""
        standby = self._standby[0] if self._standby is not None else None
        for channel in (self._active, *self._given_up, *self._unidentified, standby):
            if channel is not None:
                channel.close()
        self._active = self._standby = None
        self._pid = 0
        if self._process is not None:
            with suppress(ProcessLookupError):  # stand-bys and back ends, which stay in its group, end too
                os.killpg(self._process.pid, signal.SIGKILL)
            if self._process.stdin is not None:
                self._process.stdin.close()
            self._bury()
        self._mapper_socket.close()

    def _listen(self) -> None:
        standby = [self._standby[0]] if self._standby is not None else []
        active = self._active
        ends = [*([active] if active is not None else []), *standby, *self._unidentified]
        for end in wait_for([*ends, Listening(self._mapper_socket.server)], LISTEN_S):
            if not isinstance(end, Channel):
                self._accept()
            elif end is active:
                self._hear(end)
            elif end in self._unidentified:
                self._identify(end)
            else:
                self._lose_standby(end)

    def _accept(self) -> None:
        while True:
            try:
                connection, _ = self._mapper_socket.server.accept()
            except BlockingIOError:
                return
            self._unidentified.append(Channel(connection))

    def _identify(self, channel: Channel) -> None:
        try:
            hellos = channel.receive()
        except ChannelClosedError:
            self._unidentified.remove(channel)
            channel.close()
            return
        if not hellos:
            return
        self._unidentified.remove(channel)
        hello = hellos[0]
        if not hello.is_standby:
            with self._lock:
                self._active, self._pid, self._last_pid = channel, hello.pid, hello.pid
            channel.send(self._setup)  # where it is gone by now, that is read next
            return
        if hello.of_pid != self._last_pid or hello.number < self._forgotten_number:
            # A copy of a mapper that is lost by now, which may have decided what it never sent; or one that a
            # newer copy has overtaken, for which items that it would need are forgotten.
            channel.close()  # it ends by that
            return
        if self._standby is not None:
            self._standby[0].close()
        self._standby = (channel, hello)
        self._forget_up_to(hello.number)

    def _forget_up_to(self, number: int) -> None:
        self._forgotten_number = number
        with self._lock:
            while self._kept and self._kept[0].number <= number:
                self._kept.popleft()
        self._applied = {n: count for n, count in self._applied.items() if n > number}
        self._passed_over = {n for n in self._passed_over if n > number}

    def _hear(self, active: Channel) -> None:
        try:
            messages: list[msg.FromMapper | msg.Fatal] = active.receive()
        except ChannelClosedError:
            self._lost("ended")
            return
        self._silence.heard()
        for message in messages:
            if isinstance(message, msg.Failed):
                self._fatal(message)
                return
            if isinstance(message, msg.BackEndDied):
                self._back_ends_died_s.append(time.monotonic())
                self._lost(f"is without its graph: {message.words}")
                return
            self._take(message)

    def _take(self, message: msg.FromMapper) -> None:
        if isinstance(message, msg.Ready):
            self._begin(message)
            return
        if isinstance(message, msg.Finished):
            if message.back_end_stood_still and self._deadline is not None:
                self._deadline.found_hung()
            self._finished.set()
            return
        if isinstance(message, msg.CanCopy):
            self._keep_items(message.can_copy)
            return
        if isinstance(message, msg.LongWork):
            self._silence.announce(message.has_begun)
            return
        if isinstance(message, msg.Progress):
            self.kernels, self.kernels_share = message.words, message.share
            return
        if isinstance(message, msg.Status):
            self._taken_number = message.number
        elif isinstance(message, msg.ResultApplied):
            self._applied[message.number] = self._applied.get(message.number, 0) + 1
        elif isinstance(message, msg.Mapped | msg.PassedOver | msg.Unusable | msg.Answer):
            # The answer to an edit comes after those to later items.
            self._done_number = self._taken_number = max(self._done_number, message.number)
            if isinstance(message, msg.PassedOver):
                self._passed_over.add(message.number)
        if isinstance(message, msg.Answer):
            with self._lock:
                answered = self._answers.pop(message.number, None)
            if answered is not None:
                answered(message)
        else:
            self._listener.heard(message)

    def _begin(self, ready: msg.Ready) -> None:
        """The process is ready: what has been submitted meanwhile goes out."""
        with self._lock:
            assert self._active is not None
            for item in self._kept:
                self._active.send(item)
            self._keeps_items = ready.has_standby
            if not self._keeps_items:
                self._kept.clear()
            self._ready.set()
            if self._deadline is not None:
                self._active.send(msg.Finish())

    def _keep_items(self, for_standby: bool) -> None:
        """From now on, or not any more. A stand-by that would need an item from before is refused."""
        with self._lock:
            self._keeps_items = for_standby
            if for_standby:
                self._forgotten_number = self._number
            else:
                self._kept.clear()
        if not for_standby and self._standby is not None:
            self._standby[0].close()  # it would map on with the profile before
            self._standby = None

    def _watch(self) -> None:
        if self._orphaned is not None:
            self._take_over()
        elif self._active is None and self._ready.is_set() and not self._finished.is_set():
            self._lost("closed its connection")
        with self._lock:
            if self._delayed and time.monotonic_ns() - self._delayed[0].arrived_ns > HOLD_NS:
                self._send_delayed()
        is_mapping = self._active is not None and self._ready.is_set() and not self._finished.is_set()
        is_owing = is_mapping and (self.waiting > 0 or self._deadline is not None)
        if is_owing and self._silence.is_too_long(self._pid):
            if self._deadline is not None:
                self._deadline.found_hung()
            self._lost(f"said nothing for {self.silent_s:.1f} s while {self.waiting} items waited")

    def _lose_standby(self, channel: Channel) -> None:
        try:
            channel.receive()
        except ChannelClosedError:
            self._standby = None
            channel.close()
            with self._lock:
                if self._active is not None:
                    self._active.send(msg.MakeStandby())

    def _fatal(self, failed: msg.Failed) -> None:
        """The mapper raised: its stand-by goes on without that frame."""
        with self._lock:
            kept = list(self._kept)  # readers add to it meanwhile
        item = next((item for item in kept if item.number == failed.number), None)
        if isinstance(item, msg.FrameItem):
            self._refused.add(failed.number)
            self._listener.refused(item)
        self._lost(f"failed at {failed.words}")

    def _lost(self, how: str) -> None:
        if self._closed.is_set():
            return
        self._end_active()
        if self._finished.is_set():
            return
        if not self._ready.is_set():
            raise MapperLostError(f"the mapper's process {how} before it was ready; its log stands above")
        deaths, at_number = self._deaths
        self._deaths = (deaths + 1 if at_number == self._done_number else 1, self._done_number)
        if self._deaths[0] >= MAX_DEATHS:
            raise MapperLostError(
                f"the mapper's process {how}, {MAX_DEATHS} times after item {self._done_number}"
            )
        self.restarts += 1
        self._orphaned = (how, time.monotonic())
        self._take_over()

    def _take_over(self) -> None:
        """Put the stand-by in the mapper's place; it may still be starting."""
        assert self._orphaned is not None
        how, since_s = self._orphaned
        if self._standby is None:
            if time.monotonic() - since_s > (STILL_S if self._deadline is not None else STANDBY_S):
                raise MapperLostError(f"the mapper's process {how}, and no stand-by was there")
            return
        self._orphaned = None
        channel, hello = self._standby
        self._standby = None
        log.error(
            "the mapper's process %s; a stand-by (%d) goes on after item %d of %d",
            how,
            hello.pid,
            hello.number,
            self._number,
        )
        decisions = msg.Decisions(self._applied, frozenset(self._passed_over), frozenset(self._refused))
        self._listener.taken_over(how)
        with self._lock:
            self._active, self._pid, self._last_pid = channel, hello.pid, hello.pid
            self._silence.begin()
            for message in (
                msg.Go(self._done_number, decisions, self._back_end_dies_again_and_again()),
                *self._kept,
                *([msg.Finish()] if self._deadline is not None else []),
            ):
                if self._active is not None:  # else the next turn finds it lost, too
                    self._send(message)

    def _back_end_dies_again_and_again(self) -> bool:
        died_s = self._back_ends_died_s
        return len(died_s) == MAX_BACK_END_DEATHS and died_s[-1] - died_s[0] < BACK_END_DEATHS_WITHIN_S

    def _end_active(self) -> None:
        with self._lock:
            for channel in (self._active, *self._given_up):
                if channel is not None:
                    channel.close()
            self._active = None
            self._given_up.clear()
            self._delayed.clear()  # they are among those kept
        pid, self._pid = self._pid, 0
        _kill(pid)

    def _bury(self) -> None:
        """Reap the killed process that was started here, within a bounded time. Not before the end: until
        then no other process gets its number, which is that of the group.
        """
        assert self._process is not None
        try:
            self._process.wait(END_S)
        except subprocess.TimeoutExpired:
            log.error(
                "the mapper's process (%d) was killed and has not ended within %g s; it waits for a disk or "
                "for memory that hangs, `cat /proc/%d/wchan` says where. It is left behind",
                *(self._process.pid, END_S, self._process.pid),
            )
        else:
            self._process = None


def _kill(pid: int) -> None:
    if pid > 0:
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
