"""All that commands act on, with real parts: intake, mapping loop, map saver and recorder."""

import json
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from service.encoding import LogClock, Message
from service.errors import InputError
from service.mapper.mapping_session import MappingSession
from service.mapper.profiles import mapping_config
from service.mapstore.config import MapConfig
from service.mapstore.files import load_map
from service.mapstore.graph_files import GraphFolder
from service.mapstore.tiles import TileStore
from service.publishing.commands import Answer as CommandAnswer
from service.publishing.commands import CommandDispatcher, CommandError
from service.recording.config import RecordingConfig
from service.recording.mcap_reader import Recording
from service.recording.mcap_recorder import McapRecorder
from service.runtime.commands import Commands
from service.runtime.host_time import HostTime
from service.runtime.intake import Intake
from service.runtime.mapping_outputs import MappingOutputs
from service.runtime.profile_switch import PresentMapping, ProfileSwitch
from service.sinks.map_saver import MapSaver
from service.sinks.mcap_sink import McapSink
from tests.service.mapstore.tile_makers import graph_of
from tests.service.runtime.inline_link import InlineLink
from tests.service.runtime.mapping_runs import OFFSET_NS, FakeMapper, scan
from tests.service.sinks.contexts import sink_context


class Machine:
    """All that commands act on."""

    def __init__(self, folder: Path, free_bytes: list[int], is_deaf: bool = False) -> None:
        self.tiles = TileStore()
        self.command: Callable[[], CommandAnswer] = lambda: CommandAnswer(True, b"{}")  # of the map saver
        host_time, log_clock = HostTime(OFFSET_NS), LogClock()
        context = sink_context(
            map_folder=folder / "map",
            tiles=self.tiles,
            emit=self._put,
            command=lambda verb, payload: self.command(),
            unix_ns=lambda: host_time.unix_ns(time.monotonic_ns()),
            is_paused=lambda: self.intake.paused,
            present_profile=lambda: self.present.profile,
        )
        self.recorder = McapSink(RecordingConfig(directory=folder / "in"), context)
        self.recorder._recorder = McapRecorder(
            folder / "in", "veh1", keep_free_bytes=1000, free_bytes_of=lambda _: free_bytes[0]
        )
        self.saver = MapSaver(MapConfig(directory=folder, checkpoint_s=3600.0), context)
        self.outputs = MappingOutputs(
            ["front"],
            self.tiles,
            self._put,
            lambda tiles, stamp_ns: None,
            lambda: log_clock.next_ns(host_time.unix_ns(time.monotonic_ns())),
        )
        self.prepared: list[tuple[str, int]] = []  # stored maps that mappers began in
        self.mapper_fault = ""  # why the mapper cannot read a stored map
        session = MappingSession(FakeMapper, ["front"], None)
        self.profiles: list[Mapping[str, Any]] = []  # sections that mappers began again with
        self.compiled: list[Mapping[str, Any]] = []
        self.compiler_fault = ""
        self.compiler: Callable[[], None] = lambda: None  # works until it returns
        self.present = PresentMapping(mapping_config())
        self.link = InlineLink(session, self.outputs, is_deaf, self._prepare, self.profiles.append)
        self._folder = folder
        self.intake = Intake(self.link, host_time, self._put)  # type: ignore[arg-type]
        parts = self.intake, self.outputs, self._put
        switch = ProfileSwitch(self.present, *parts, self.saver, self._compile)
        self.commands = Commands(*parts, self.recorder, self.saver, self._find, switch)
        self.dispatcher = CommandDispatcher(self.commands.verbs(), answer_timeout_s=20.0)
        self._scans = 0

    def checkpoints_in(self, folder: Path) -> None:
        """Have each checkpoint write a graph of five key frames there."""
        keep = GraphFolder(folder)

        def checkpoint() -> CommandAnswer:
            self.tiles.keep_graph(Path(keep(graph_of(5)).folder))
            return CommandAnswer(True, b"{}")

        self.command = checkpoint
        self.saver.mapped_by("corridor", stores_graph=True)

    def start(self) -> None:
        self.recorder.start()
        self.saver.start()

    def scan(self, count: int = 1, at_ns: int | None = None) -> None:
        """at_ns: of all of them, but for nanoseconds; else each comes now."""
        for _ in range(count):
            self._scans += 1
            now_ns = self.link.now_ns = time.monotonic_ns() if at_ns is None else at_ns + self._scans
            self.intake.put(scan(now_ns, now_ns, [1.0, 2.0, float(self._scans)]))

    def ask(self, verb: str, **request: object) -> dict[str, Any]:
        facts: dict[str, Any] = json.loads(self.dispatcher.answer(verb, json.dumps(request).encode()).body)
        return facts

    def stop(self) -> list[Path]:
        self.intake.close()
        self.saver.flush()
        self.recorder.close()
        return self.recorder.written()

    def _prepare(self, folder: str, version: int) -> None:
        if self.mapper_fault:
            raise InputError(self.mapper_fault)
        self.prepared.append((folder, version))

    def _compile(self, section: Mapping[str, Any]) -> None:
        self.compiler()
        if self.compiler_fault:
            raise CommandError(self.compiler_fault)
        self.compiled.append(section)

    def _find(self, name: str, version: int | None) -> tuple[Path, int]:
        try:
            return self._folder / name, load_map(self._folder / name, version).number
        except InputError as error:
            raise CommandError(str(error)) from error

    def _put(self, message: Message, arrived_ns: int | None = None) -> None:
        self.recorder.put(message, arrived_ns)


def channels(path: Path) -> list[str]:
    """In the order of log times, without what a pose brings with it."""
    return [m.channel for m in Recording([path]).messages() if m.channel not in ("odom", "tf", "map")]
