"""What a vehicle did, a line each 10 s and with each change of its state, kept on its disk: the fleet fetches
it in order, also what came about while there was no link.
"""

import json
import logging
import math
import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

from service.encoding import Message, decode_diagnostics, decode_pose
from service.errors import InputError, StorageError

log = logging.getLogger(__name__)

PERIOD_NS = 10_000_000_000
MAX_LINES = 100_000  # eleven days, 20 to 50 MB; the oldest go
PAGE_LINES = 500  # of one answer, 0.1 to 0.25 MB
_TABLE = "CREATE TABLE IF NOT EXISTS journal (unix_ns INTEGER PRIMARY KEY, line TEXT NOT NULL)"


class FleetJournal:
    """Any thread notes and never waits; one writes."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._waiting: SimpleQueue[tuple[int, str]] = SimpleQueue()
        self._pose: Message | None = None
        self._noted = (-PERIOD_NS, "")  # when, and the state then
        self.fault = ""  # why what was to be written last is not, "" if it is

    def pose(self, message: Message) -> None:
        self._pose = message

    def health(self, message: Message) -> None:
        """Once a second; most of them make no line."""
        rows = {row.name: row for row in decode_diagnostics(message.payload)}
        mapping = rows.get("mapping")
        state = mapping.values.get("state", "waiting") if mapping is not None else "waiting"
        now_ns = message.log_ns
        if state == self._noted[1] and 0 <= now_ns - self._noted[0] < PERIOD_NS:
            return
        self._noted = now_ns, state
        line: dict[str, Any] = {"state": state, "reason": mapping.message if mapping is not None else ""}
        line |= self._where()
        line["map"] = Path(rows["map"].values.get("folder", "")).name if "map" in rows else ""
        line["faults"] = [row.name for row in rows.values() if row.level]
        self._waiting.put((now_ns, json.dumps(line)))

    def write(self) -> None:
        """What waits, to the disk. A fault is logged once, and what it concerns is not in the journal."""
        lines = []
        try:
            while True:
                lines.append(self._waiting.get_nowait())
        except Empty:
            pass
        if not lines:
            return
        try:
            with _opened(self.path) as journal, journal:
                last_ns = journal.execute("SELECT coalesce(max(unix_ns), 0) FROM journal").fetchone()[0]
                for unix_ns, line in lines:
                    last_ns = max(unix_ns, last_ns + 1)  # a clock that was set back does not change the order
                    journal.execute("INSERT INTO journal VALUES (?, ?)", (last_ns, line))
                journal.execute(
                    "DELETE FROM journal WHERE unix_ns <= "
                    "(SELECT unix_ns FROM journal ORDER BY unix_ns DESC LIMIT 1 OFFSET ?)",
                    (MAX_LINES,),
                )
            self.fault = ""
        except StorageError as error:
            if str(error) != self.fault:
                log.error("fleet: %s", error)
            self.fault = str(error)

    def page(self, after_ns: int) -> bytes:
        """JSON, one object a line, each with its unix_ns: the next PAGE_LINES at most.

        Raises StorageError.
        """
        if not self.path.exists():
            return b""
        with _opened(self.path) as journal:
            rows = journal.execute(
                "SELECT unix_ns, line FROM journal WHERE unix_ns > ? ORDER BY unix_ns LIMIT ?",
                (after_ns, PAGE_LINES),
            ).fetchall()
        return "".join(json.dumps({"unix_ns": ns, **json.loads(line)}) + "\n" for ns, line in rows).encode()

    def _where(self) -> dict[str, float]:
        """Base in map."""
        if self._pose is None:
            return {}
        try:
            pose = decode_pose(self._pose.payload).pose
        except InputError:
            return {}
        at = {"x_m": round(pose.x_m, 3), "y_m": round(pose.y_m, 3)}
        at["heading_deg"] = round(math.degrees(pose.theta_rad), 1)
        return at if all(map(math.isfinite, at.values())) else {}


@contextmanager
def _opened(path: Path) -> Iterator[sqlite3.Connection]:
    """Raises StorageError, also for what is done inside."""
    try:
        with closing(sqlite3.connect(path, timeout=2.0)) as journal:
            journal.execute("PRAGMA journal_mode=WAL")
            journal.execute("PRAGMA synchronous=NORMAL")
            journal.execute(_TABLE)
            yield journal
    except sqlite3.Error as error:
        raise StorageError(f"{path}: {error}") from error
