"""The mapper's side: items by their number -> poses, tiles, answers. No process, socket or thread in here."""

import logging
import math
import time
from collections import deque
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any

from drivers.frames import Frame, LaserScan
from service.encoding import decode_frame, encode_odom, encode_pose, encode_tf
from service.errors import CorridorError, InputError
from service.geometry.se2 import SE2
from service.mapper.background import BackEndDiedError
from service.mapper.components import GraphRequestError
from service.mapper.map_changes import NOTHING_CHANGED, MapChanges
from service.mapper.mapping_session import MappingSession
from service.mapper.saved_graph import KeptGraph
from service.mapper.timed import note_mapped
from service.outputs import NO_GRAPH, GraphPicture, MapperOutput
from service.runtime import mapper_messages as msg
from service.timing import Timed, Timing
from service.timing.words import kind_of

TILE_INTERVAL_NS = 200_000_000
TILES_OVERDUE_NS = 1_000_000_000  # then they are handed over though items wait
# Handed over between two items, which takes 1 to 2 ms. A loop that closes may change all tiles of a map.
MAX_TILES = 64
STATUS_INTERVAL_NS = 200_000_000
STANDING_INTERVAL_NS = 2_000_000_000
STANDING_OVERDUE_NS = 8_000_000_000  # then it is rendered though items wait, which takes 1 to 3 ms

log = logging.getLogger(__name__)

PrepareMap = Callable[[str, int], None]  # folder and version: the next new mapper begins there
PrepareProfile = Callable[[Mapping[str, Any]], None]  # section of a config: the next new mapper maps so


def no_stored_maps(folder: str, version: int) -> None:
    raise InputError(f"{folder}, version {version}: this mapper begins in no stored map")


def one_profile(mapping: Mapping[str, Any]) -> None:
    raise InputError(f"{mapping.get('profile')}: this mapper has one profile")


class MapperError(Exception):
    """The mapper failed, or gave an invalid pose."""

    def __init__(self, number: int, words: str) -> None:
        super().__init__(words)
        self.number = number


class MappingLoop:
    """Owns the mapper and takes items in the order of their numbers; their results go to `send`.

    It maps what the recording holds, so a replay of the file gives the same poses. Two things are decided by
    the clock: when a result of the graph's back end is applied, and which scans are too old to be mapped.
    Both are reported, and the recording holds them.

    prepare_map      makes a stored map that in which the session's next mapper begins. Raises CorridorError
    prepare_profile  makes a profile that of the session's next mapper, which begins a new map. Raises
                     CorridorError
    graph_behind_s   as of Status
    """

    def __init__(
        self,
        mapper: MappingSession,
        send: Callable[[msg.Heard | msg.Answer | msg.LongWork], None],
        upside_down: Collection[str] = (),
        monotonic_ns: Callable[[], int] = time.monotonic_ns,
        prepare_map: PrepareMap = no_stored_maps,
        prepare_profile: PrepareProfile = one_profile,
        graph_behind_s: Callable[[], float] = lambda: 0.0,
    ) -> None:
        self.mapper = mapper
        self._timing = Timing(mapper.lasers, mapper.counters)
        self._warned: set[str] = set()  # kinds of warnings that are in the log
        self._newest: msg.FrameItem | None = None
        self._prepare_map = prepare_map
        self._prepare_profile = prepare_profile
        self._graph_behind_s = graph_behind_s
        self._send = send
        self._upside_down = frozenset(upside_down)
        self._monotonic_ns = monotonic_ns
        self._tiles_due_ns = self._status_due_ns = self._standing_due_ns = 0
        self._standing_stamp_ns = 0  # of the newest scan in what was rendered last
        self._reported_graph: Any = None  # the newest checkpoint that ingest knows of
        self._shown_graph: GraphPicture | None = None  # the newest that ingest has
        self._shown_changes: MapChanges | None = None  # likewise
        self._reported_refused: tuple[float, float, float] | None = None
        self._map_stamp_ns = 0  # Unix time of the newest scan in the map
        self._done_number = 0  # up to here nothing is decided again, and nothing is reported twice
        self._decided = msg.Decisions({}, frozenset(), frozenset())
        self._edits: deque[int] = deque()  # numbers of the items whose answers come with a result
        self.number = 0  # the last item taken
        self.has_tiles = False  # more may wait to be handed over: the next call of keep_up gives some

    @property
    def is_up_to_date(self) -> bool:
        """False while items come again after another mapper was lost."""
        return self.number >= self._done_number

    def go_on(self, go: msg.Go) -> None:
        """Items after `number` come again. What the mapper before had decided about them holds."""
        self._done_number, self._decided = go.done_number, go.decisions

    def take(self, item: msg.Item) -> None:
        """Raises MapperError."""
        self._apply_results_before(item)
        if isinstance(item, msg.FrameItem):
            self._take_frame(item)
        else:
            with self._long_work():
                self._carry_out(item)
        self.number = item.number

    @contextmanager
    def _long_work(self) -> Iterator[None]:
        self._send(msg.LongWork(True))
        yield
        self._send(msg.LongWork(False))

    def _carry_out(
        self, item: msg.SessionItem | msg.LoadItem | msg.SwitchItem | msg.GraphItem | msg.TilesItem
    ) -> None:
        if isinstance(item, msg.SessionItem):
            if item.action == "reset_map":
                self.hand_over_tiles()  # they are of the map before
                self._give_up_edits("the map has ended before the change was made")
            self._tell(item.number, msg.Answer(item.number, self.mapper.carry_out(item.action)))
        elif isinstance(item, msg.LoadItem):
            self._start_over(item, partial(self._prepare_map, item.folder, item.version))
        elif isinstance(item, msg.SwitchItem):
            self._start_over(item, partial(self._prepare_profile, item.mapping))
        elif isinstance(item, msg.GraphItem):
            answer = self._request(item)
            if answer is None:
                self._edits.append(item.number)
            else:
                self._tell(item.number, answer)
        else:
            self.hand_over_tiles()
            self._tell(item.number, msg.Answer(item.number, None))

    def keep_up(self, is_idle: bool) -> None:
        """Hand over tiles and tell the status where they are due; between two items."""
        now_ns = self._monotonic_ns()
        if self.is_up_to_date and now_ns >= self._tiles_due_ns + (0 if is_idle else TILES_OVERDUE_NS):
            self.hand_over_tiles(MAX_TILES)
            self._tiles_due_ns = now_ns + (0 if self.has_tiles else TILE_INTERVAL_NS)
        if now_ns >= self._standing_due_ns + (0 if is_idle else STANDING_OVERDUE_NS):
            self._standing_due_ns = now_ns + STANDING_INTERVAL_NS
            self._show_standing()
        if now_ns >= self._status_due_ns:
            self._status_due_ns = now_ns + STATUS_INTERVAL_NS
            self._show_graph()
            self._show_changes()
            self.tell_status()

    def hand_over_tiles(self, most: int | None = None) -> None:
        """Send tiles that changed since the last call, at most so many. While items come again they wait:
        they would be old.
        """
        self.has_tiles = False
        if not self.is_up_to_date:
            return
        if changed := self.mapper.changed_tiles(most):
            self._send(msg.Tiles(changed, self._map_stamp_ns))
            self.has_tiles = len(changed) == most

    def _tell_graph(self) -> None:
        kept = self.mapper.saved
        if kept is not self._reported_graph and isinstance(kept, KeptGraph):
            self._reported_graph = kept
            self._send(kept)

    def _show_graph(self) -> None:
        picture = self.mapper.graph_picture
        if picture is not self._shown_graph and self.is_up_to_date:
            self._shown_graph = picture
            self._send(msg.GraphRendered(picture if picture is not None else NO_GRAPH))

    def _show_changes(self) -> None:
        """Send the changes where the reported cells differ from before."""
        facts, shown = self.mapper.changes_reported, self._shown_changes
        if facts is shown or not self.is_up_to_date:
            return
        self._shown_changes = facts
        if facts is None or not facts.has_same_cells(shown):
            grid = NOTHING_CHANGED if facts is None else facts.as_grid()
            self._send(msg.ChangesRendered(grid, self._map_stamp_ns))

    def _show_standing(self) -> None:
        if not self.is_up_to_date or self._map_stamp_ns == self._standing_stamp_ns:
            return
        self._standing_stamp_ns = self._map_stamp_ns
        if (grid := self.mapper.standing()) is not None:
            self._send(msg.StandingRendered(grid, self._map_stamp_ns))

    def tell_status(self) -> None:
        warnings = tuple(self._timing.warnings)
        for warning in warnings:
            if kind_of(warning) not in self._warned:
                self._warned.add(kind_of(warning))
                log.warning("%s", warning)
        self._send(
            msg.Status(
                number=self.number,
                counters=dict(self.mapper.counters),
                graph_fault=self.mapper.graph_fault,
                graph_behind_s=self._graph_behind_s(),
                geo_reference=self.mapper.geo_reference,
                cpu_s=time.process_time(),
                time_warnings=warnings,
                is_localizing=self.mapper.is_localizing,
            )
        )

    def finish(self) -> None:
        """After the last item: the graph's last word, and the tiles that it changed.

        That may take longer than ingest waits for a mapper with items before it, so it hears that none are.
        """
        if self._newest is not None:
            self._map_timed(self._timing.finish(), self._newest)
        self.tell_status()
        with self._long_work():
            self.mapper.finish()
        self._tell_graph()
        self._show_graph()
        self.hand_over_tiles()
        self.tell_status()

    def _apply_results_before(self, item: msg.Item) -> None:
        for _ in range(self._decided.applied.get(item.number, 0)):
            self._apply_result()
        if msg.is_sample(item):
            return  # a scan comes soon
        if item.number > self._done_number and self.mapper.work_ready:
            self._apply_result()
            self._send(msg.ResultApplied(item.number, item.log_ns, self.mapper.graph_fault))
            self._tell_graph()
        refused = self.mapper.pose_refused
        if refused != self._reported_refused:
            self._reported_refused = refused
            if refused is not None:
                self._tell(item.number, msg.PoseRefused(item.log_ns, SE2(*refused)))

    def _apply_result(self) -> None:
        """The answer to an edit may be sent again after a mapper was lost: only the first is heard."""
        with self._long_work():
            self.mapper.apply_result()
        if not self._edits:
            return
        for edited in self.mapper.take_edited():
            self._send(msg.Answer(self._edits.popleft(), edited.reply, edited.error))
        if self.mapper.graph_fault:
            self._give_up_edits(f"the change is not made: {self.mapper.graph_fault}")

    def _give_up_edits(self, why: str) -> None:
        while self._edits:
            self._send(msg.Answer(self._edits.popleft(), None, why))

    def _take_frame(self, item: msg.FrameItem) -> None:
        if item.number in self._decided.refused:
            return
        is_turned = item.sensor in self._upside_down
        frame = decode_frame(item.type, item.payload, item.sensor, item.log_ns, is_turned)
        if frame is None:
            is_mapped = item.sensor in self.mapper.lasers and not msg.is_sample(item)
            self._tell(item.number, msg.Unusable(item.number, item.sensor, is_mapped))
            return
        self._newest = item
        is_mapped = not (isinstance(frame, LaserScan) and self._is_passed_over(frame, item))
        self._map_timed(self._timing.take(frame, is_mapped), item)

    def _map_timed(self, frames: Sequence[Timed], item: msg.FrameItem) -> None:
        """Map the frames that the newest item releases: mostly its own."""
        for frame, is_mapped in frames:
            if is_mapped:
                self._map_frame(frame, item)
            elif isinstance(frame, LaserScan):
                self.mapper.pass_over(frame)

    def _map_frame(self, frame: Frame, item: msg.FrameItem) -> None:
        before_ns = time.thread_time_ns()
        output = self._map(frame, item)
        note_mapped(self._timing, self.mapper, frame, output)
        if output is None:
            return
        self._map_stamp_ns = output.stamp_ns
        messages = (encode_pose(output, 0), encode_odom(output, 0), encode_tf(output, 0))
        cpu_ns = time.thread_time_ns() - before_ns
        self._tell(
            item.number,
            msg.Mapped(
                number=item.number,
                arrived_ns=item.arrived_ns,
                stamp_ns=output.stamp_ns,
                state=output.state,
                reason=output.reason,
                inlier_ratio=output.inlier_ratio,
                cpu_ns=cpu_ns,
                messages=messages,
            ),
        )

    def _is_passed_over(self, scan: LaserScan, item: msg.FrameItem) -> bool:
        """Whether a scan has waited too long; then the mapper only goes on by wheels and gyro."""
        if item.number <= self._done_number:
            return item.number in self._decided.passed_over
        age_ns = self._monotonic_ns() - item.arrived_ns
        if age_ns <= max(msg.MAX_AGE_NS, 2 * scan.scan_period_ns) or not self.mapper.maps(scan):
            return False
        self._send(msg.PassedOver(item.number, item.log_ns, item.sensor, age_ns))
        return True

    def _map(self, frame: Frame, item: msg.FrameItem) -> MapperOutput | None:
        kind = "scan" if isinstance(frame, LaserScan) else "sample"
        try:
            output = self.mapper.process(frame)
        except BackEndDiedError:
            raise
        except Exception as error:
            words = f"{kind} of {frame.sensor} stamped {frame.stamp_ns}: {error!r}"
            raise MapperError(item.number, words) from error
        if output is not None:
            pose = output.pose_map_base
            if not all(map(math.isfinite, pose)):
                words = f"{kind} of {frame.sensor} stamped {frame.stamp_ns} gave the pose {pose}"
                raise MapperError(item.number, words)
        return output

    def _start_over(self, item: msg.LoadItem | msg.SwitchItem, prepare: Callable[[], None]) -> None:
        """The map before stays where what the next one needs cannot be had."""
        self.hand_over_tiles()  # they are of the map before
        try:
            prepare()
        except CorridorError as error:
            self._tell(item.number, msg.Answer(item.number, None, str(error)))
            return
        self._give_up_edits("the map has ended before the change was made")
        self._tell(item.number, msg.Answer(item.number, self.mapper.carry_out("reset_map")))

    def _request(self, item: msg.GraphItem) -> msg.Answer | None:
        """None: the answer comes with a result."""
        try:
            result = self.mapper.request(item.name, item.payload)
            return None if result is None else msg.Answer(item.number, result)
        except GraphRequestError as error:
            return msg.Answer(item.number, None, str(error))

    def _tell(self, number: int, message: msg.Heard | msg.Answer) -> None:
        if number > self._done_number:
            self._send(message)
