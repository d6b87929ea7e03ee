"""What one sink does must not reach another, nor whoever puts."""

import logging
import threading
from collections.abc import Iterator, Sequence

import pytest

from service import deadline
from service.deadline import Deadline
from service.encoding import ERROR, OK, Message, Status
from service.errors import StorageError
from service.outputs import TileUpdate
from service.sinks import fan_out
from service.sinks.fan_out import Sinks
from service.sinks.registry import SinkKind
from service.sinks.sink import Sink, SinkContext
from tests.service.mapstore.tile_makers import tile
from tests.service.sinks.contexts import sink_context


class ListSink(Sink):
    """Keeps what it is given; `fails` names the methods that raise."""

    def __init__(self, name: str = "list", fails: Sequence[str] = (), error: Exception | None = None) -> None:
        self.name = name
        self._fails = fails
        self._error = error or RuntimeError("out of order")
        self.messages: list[tuple[Message, int | None]] = []
        self.tiles: list[tuple[Sequence[TileUpdate], int, int]] = []
        self.ended: list[str] = []
        self.may_end = threading.Event()
        self.may_end.set()

    def put(self, message: Message, arrived_ns: int | None = None) -> None:
        self._do("put")
        self.messages.append((message, arrived_ns))

    def put_tiles(self, tiles: Sequence[TileUpdate], stamp_ns: int, log_ns: int) -> None:
        self._do("put_tiles")
        self.tiles.append((tiles, stamp_ns, log_ns))

    def health(self) -> Status:
        self._do("health")
        return Status(self.name, OK, "ok", {"messages": str(len(self.messages))})

    def flush(self) -> None:
        self._do("flush")
        self.may_end.wait(20.0)
        self.ended.append("flush")

    def close(self) -> None:
        self._do("close")
        self.may_end.wait(20.0)
        self.ended.append("close")

    def _do(self, what: str) -> None:
        if what in self._fails:
            raise self._error


def message(channel: str = "pose") -> Message:
    return Message(channel, "std_msgs/msg/String", 1, 2, b"")


# Kinds for `Sinks.open`: a registry line names them by module and name.
OPENED: list[ListSink] = []


def open_list(section: str, context: SinkContext) -> ListSink | None:
    if section == "off":
        return None
    if section == "refused":
        raise StorageError("the port is taken")
    OPENED.append(ListSink(section))
    return OPENED[-1]


def kind(section: str) -> SinkKind:
    return SinkKind(section, "none:none", f"{__name__}:open_list")


@pytest.fixture(autouse=True)
def _no_sink_is_open() -> Iterator[None]:
    OPENED.clear()
    yield
    OPENED.clear()


def test_where_one_cannot_be_opened_those_before_are_closed():
    names = {name: name for name in ("first", "refused")}
    with pytest.raises(StorageError, match="the port is taken"):
        Sinks().open([kind(name) for name in names], names, sink_context())  # type: ignore[arg-type]
    assert OPENED[0].ended == ["close"]


def test_every_sink_gets_every_message_and_every_tile():
    first, second = ListSink("first"), ListSink("second")
    sinks = Sinks([first, second])
    pose, tiles = message(), [tile(0, 0, 1)]
    sinks.put(pose, 7)
    sinks.put_tiles(tiles, 10, 11)
    for sink in (first, second):
        assert sink.messages == [(pose, 7)]
        assert sink.tiles == [(tiles, 10, 11)]


@pytest.mark.parametrize("what", ["put", "put_tiles"])
def test_a_sink_that_raises_is_an_error_in_health_reported_once_and_the_next_gets_all(
    what: str, caplog: pytest.LogCaptureFixture
):
    broken, well = ListSink("broken", [what]), ListSink("well")
    sinks = Sinks([broken, well])
    for _ in range(3):
        sinks.put(message())
        sinks.put_tiles([tile(0, 0, 1)], 1, 1)
    assert (len(well.messages), len(well.tiles)) == (3, 3)
    assert [record.levelno for record in caplog.records] == [logging.ERROR]
    broken_row, well_row = sinks.health()
    assert broken_row.level == ERROR
    assert broken_row.values["reason_id"] == "output_failed"
    assert broken_row.message.startswith("it raised RuntimeError: out of order")
    assert broken_row.values["refused"] == "3"
    assert well_row == Status("well", OK, "ok", {"messages": "3"})


def test_a_thread_of_a_sink_that_dies_is_the_sink_s_fault_and_another_thread_is_not():
    sinks = Sinks([ListSink("list"), ListSink("other")])
    assert not sinks.thread_died("listless", ValueError("x"))
    assert sinks.thread_died("list-writer", ValueError("x"))
    rows = {row.name: row for row in sinks.health()}
    assert (rows["list"].level, rows["list"].message) == (ERROR, "thread list-writer died: ValueError: x")
    assert rows["other"].level == OK
    assert sinks.thread_died("other", ValueError("x"))
    assert [row.level for row in sinks.health()] == [ERROR, ERROR]


def test_what_is_lost_while_closing_is_reported_and_other_faults_cost_nothing():
    full = ListSink("full", ["close"], StorageError("recording: no space"))
    assert Sinks([full, ListSink("odd", ["close"])]).close(Deadline()) == ["recording: no space"]


@pytest.mark.parametrize("action", ["flush", "close"])
@pytest.mark.parametrize(("stall_s", "deadline_s"), [(0.2, 60.0), (60.0, 0.2)])
def test_a_sink_that_hangs_at_the_end_is_left_behind_and_holds_up_no_other(
    action: str, stall_s: float, deadline_s: float, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(fan_out, "STALL_S", stall_s)
    monkeypatch.setattr(deadline, "WORKING_S", deadline_s)
    hangs, well = ListSink("hangs"), ListSink("well")
    hangs.may_end.clear()
    sinks = Sinks([hangs, well])
    getattr(sinks, action)(Deadline())
    assert well.ended == [action]
    row = sinks.health()[0]
    assert (row.level, row.message) == (ERROR, f"hangs did not {action} within 0 s")
    hangs.may_end.set()
