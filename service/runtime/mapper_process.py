"""The mapper's process: `python -m service.runtime.mapper_process FOLDER`, started by mapper_link.py, or
earlier by early_mapper.py.

It has one thread and waits in one place. Every few seconds, when nothing waits, it forks: the child, a
stand-by, has the complete state as it was at that item and costs only the pages that change afterwards.
When the mapper dies, the newest stand-by continues, gets all items after its own last one again, and
is where the mapper was a second later. Its messages are in mapper_messages.py.
"""

import gc
import json
import logging
import os
import signal
import socket
import sys
import threading
import time
from collections import deque
from collections.abc import Mapping
from itertools import count
from pathlib import Path
from typing import Any

from service.compile.signatures import Job
from service.compile.warm_up import KernelProgress
from service.compile.warm_up import warm_up as warm_up_kernels
from service.compile.worker import SeldomKernels
from service.encoding import warm_up as warm_up_encoding
from service.interruption import killed_with_parent, wake_group_at_end_of, wake_when_parent_ends
from service.log_format import set_up_logging
from service.mapper.background import BackEndDiedError
from service.mapper.mapping_session import MappingSession
from service.mapper.patch_store import PatchStore
from service.mapper.pipeline import Mapper
from service.mapper.profiles import MappingConfig, build_mapper, mapping_config
from service.mapstore.begin_in import begin_in
from service.mapstore.graph_files import GraphFolder
from service.mapstore.patch_files import PatchFiles
from service.runtime import mapper_messages as msg
from service.runtime.back_end import BackEndProcess
from service.runtime.channel import Channel, ChannelClosedError, wait_for
from service.runtime.early_mapper import CONFIG_ON_STDIN, SOCKET
from service.runtime.mapping import MapperError, MappingLoop
from service.runtime.standby_schedule import StandbySchedule

log = logging.getLogger(__name__)

IDLE_S = 0.2  # how long to wait for an item before tiles are served
CONNECT_S = 10.0
MAX_AT_ONCE = 100  # samples taken in a row before other work


class MapperProcess:
    """One mapper, and what it needs to fork stand-bys."""

    def __init__(
        self, folder: Path, setup: msg.Setup, channel: Channel, seldom: SeldomKernels | None = None
    ) -> None:
        """seldom: kernels that another process compiles still."""
        self._folder = folder
        self._setup = setup
        self._channel = channel
        self._seldom = seldom
        self._can_copy = True
        self._stays = False  # where the back end dies: then no loops are closed any more
        self._back_end = BackEndProcess(
            setup.graph_patience_s,
            is_replaceable=lambda: self._can_copy and not self._stays,
            is_waiting=lambda: self._loop.tell_status(),
        )
        config = mapping_config(dict(setup.mapping))

        load = Path(setup.begin_in) if setup.begin_in else None
        begins = [None if load is None else begin_in(load, config, setup.begin_version)]
        maps = count(1)

        def new_mapper() -> Mapper[Any]:
            """After a reset: a new map, but for a vehicle that is only localised."""
            begin = begins[0] if config.mode == "localization" else begins.pop() if begins else None
            return build_mapper(
                config,
                setup.mountings,
                new_worker=self._back_end.new_worker,
                new_patch_store=self._new_patch_store,
                begin_in=begin,
                keep_graph=self._keep_graph(f"map{next(maps)}"),
            )

        def prepare_map(folder: str, version: int) -> None:
            begins[:] = [begin_in(Path(folder), config, version)]

        def prepare_profile(mapping: Mapping[str, Any]) -> None:
            nonlocal config
            config = mapping_config(dict(mapping))
            warm_up_kernels(back_end_elsewhere=True, progress=_progress(self._channel))
            self._can_copy = True  # until its parts report otherwise

        self._loop = MappingLoop(
            MappingSession(new_mapper, setup.lasers, apply_after_ns=None),
            self._send,
            setup.upside_down,
            prepare_map=prepare_map,
            prepare_profile=prepare_profile,
            graph_behind_s=lambda: self._back_end.behind_s,
        )
        self._reported_can_copy = self._can_copy
        self._items: deque[msg.Item] = deque()
        self._is_finishing = False
        self._copied_number = -1
        self._copies = 0
        self._schedule = StandbySchedule()

    def run(self) -> None:
        """Until ingest reports the end, or has ended. Raises ChannelClosedError."""
        try:
            if not self._copy():
                self._send(msg.Ready(self._can_copy))
                self._announce_kernels()
            while self._items or not self._is_finishing:
                self._hear(0.0 if self._items or self._loop.has_tiles else IDLE_S)
                self._take_up_to_scan()
                if self._can_copy != self._reported_can_copy:
                    self._reported_can_copy = self._can_copy
                    self._send(msg.CanCopy(self._can_copy))
                self._loop.keep_up(is_idle=not self._items)
                self._load_seldom()
                if self._is_copy_due():
                    self._copy()
            self._loop.finish()
            self._say_last(msg.Finished(self._back_end.stood_still))
        except MapperError as error:
            log.error("the mapper failed: %s", error)
            self._say_last(msg.Failed(error.number, str(error)))
        except BackEndDiedError as error:
            self._say_last(msg.BackEndDied(str(error)))
        finally:
            self._back_end.stop()

    def _take_up_to_scan(self) -> None:
        for _ in range(MAX_AT_ONCE):
            if not self._items:
                return
            item = self._items.popleft()
            self._loop.take(item)
            if msg.is_sample(item):
                continue
            if isinstance(item, msg.FrameItem):
                self._schedule.arrived(item.sensor, item.arrived_ns)
            return

    def _hear(self, timeout_s: float) -> None:
        ready = wait_for([self._channel, *self._back_end.ends], timeout_s)
        if any(end is not self._channel for end in ready):
            self._back_end.look()  # finished work comes in before the next item
        if self._channel not in ready:
            return
        for message in self._channel.receive():
            self._take_message(message)

    def _take_message(self, message: Any) -> None:
        if isinstance(message, msg.Finish):
            self._is_finishing = True
        elif isinstance(message, msg.MakeStandby):
            self._copied_number = -1
            self._schedule.make_next_at_once()
        else:
            self._items.append(message)

    def _announce_kernels(self) -> None:
        if self._seldom is not None:
            self._send(msg.LongWork(True))  # a scan may have to compile one

    def _load_seldom(self) -> None:
        if self._seldom is None or self._items:
            return
        self._seldom.load_next()
        if self._seldom.is_done:
            self._seldom = None
            self._send(msg.LongWork(False))

    def _send(self, message: msg.FromMapper) -> None:
        self._channel.send(message)

    def _say_last(self, word: msg.FromMapper | msg.Fatal) -> None:
        self._channel.send(word)
        while not self._channel.flush():
            self._channel.wait(IDLE_S)

    def _new_patch_store(self) -> PatchStore:
        self._can_copy = False  # two processes would write to one file
        return PatchFiles()

    def _keep_graph(self, name: str) -> GraphFolder | None:
        return GraphFolder(Path(self._setup.graph_folder) / name) if self._setup.graph_folder else None

    def _is_copy_due(self) -> bool:
        if not self._can_copy or self._loop.number == self._copied_number or not self._loop.is_up_to_date:
            return False
        return self._schedule.is_due(time.monotonic_ns(), is_waiting=bool(self._items))

    def _copy(self) -> bool:
        """Fork a stand-by with the present state; True in it, when it has taken over."""
        if not self._can_copy or self._back_end.is_awaited:
            return False
        self._loop.hand_over_tiles()
        self._copied_number = self._loop.number
        self._copies += 1
        self._back_end.copy(self._folder / f"back-end-{os.getpid()}-{self._copies}.sock")
        mapper_pid = os.getpid()
        began_ns = time.monotonic_ns()
        is_copy = os.fork() == 0
        self._schedule.made(began_ns, time.monotonic_ns() - began_ns)
        self._back_end.forked(is_copy)
        if is_copy:
            self._stand_by(mapper_pid)
        return is_copy

    def _stand_by(self, mapper_pid: int) -> None:
        """In the copy of a mapper: wait until it is needed. What that had not taken yet will come again."""
        wake_when_parent_ends()
        self._channel.close()
        self._items.clear()
        self._is_finishing = False
        try:
            self._channel = connect(self._folder)
            self._channel.send(msg.Hello(os.getpid(), self._loop.number, is_standby=True, of_pid=mapper_pid))
            messages: list[Any] = []
            while not messages:
                self._back_end.look()  # a stand-by without its back end makes place for another one
                if self._channel in wait_for([self._channel, *self._back_end.ends], 3600.0):
                    messages = self._channel.receive()
        except (ChannelClosedError, BackEndDiedError):
            os._exit(0)  # a newer stand-by exists, or none is needed any more
        first, *items = messages
        assert isinstance(first, msg.Go)
        self._stays = first.stays
        self._back_end.need()
        self._announce_kernels()
        self._loop.go_on(first)
        self._copy()  # it may be needed before everything has come again
        self._schedule.make_next_at_once()  # and once more when it has
        for message in items:
            self._take_message(message)


def connect(folder: Path) -> Channel:
    """Ingest, which listens in its folder. Raises ChannelClosedError."""
    connection = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    connection.settimeout(CONNECT_S)
    try:
        connection.connect(str(folder / SOCKET))
    except OSError as error:
        raise ChannelClosedError(str(error)) from error
    return Channel(connection)


def _progress(channel: Channel) -> KernelProgress:
    """Tells ingest how many kernels are compiled. Only this thread may write to the channel."""
    own = threading.get_ident()

    def tell(progress: KernelProgress) -> None:
        if threading.get_ident() == own:
            channel.send(msg.Progress(str(progress), progress.share))

    return KernelProgress(tell)


def _reported() -> MappingConfig | None:
    """The mapping that an EarlyMapper reports; None: nothing, or what no config allows."""
    if CONFIG_ON_STDIN not in sys.argv:
        return None
    try:
        return mapping_config(json.loads(sys.stdin.readline()))
    except ValueError:
        return None  # ingest refuses it


def _load(channel: Channel) -> list[Job]:
    """The kernels that are left to be compiled, for not every scan calls them. Ends with ingest."""
    with killed_with_parent():
        warm_up_encoding()
        return warm_up_kernels(back_end_elsewhere=True, progress=_progress(channel), leaves_seldom=True)


def main() -> int:
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # ingest handles the signals, and ends this process
    folder = Path(sys.argv[1])
    try:
        facts = _reported()
        channel = connect(folder)
        channel.send(msg.Hello(os.getpid(), 0, is_standby=False))
        left: list[Job] = []
        if facts is not None:  # while ingest imports, and checks the config
            set_up_logging(logging.INFO)
            left = _load(channel)
        while not (messages := channel.receive_within(CONNECT_S)):
            pass  # ingest is starting, or gone, which ends this
        (setup,) = messages
        set_up_logging(setup.log_level)
        config = mapping_config(dict(setup.mapping))
        if facts is None or config.model_dump() != facts.model_dump():  # == compares classes, made for each
            left = _load(channel)
        wake_group_at_end_of(sys.stdin.fileno())  # all that is forked from here is in it
        signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # stand-bys end when no one needs them any more
        gc.collect()
        gc.freeze()  # these objects live as long as the process; a full collection would stall a scan
        process = MapperProcess(folder, setup, channel, SeldomKernels(left) if left else None)
        process.run()
    except ChannelClosedError:
        return 0  # ingest is gone
    return 0


if __name__ == "__main__":
    code = main()
    sys.stderr.flush()
    os._exit(code)  # a stand-by that took over has nothing of the first process to clean up
