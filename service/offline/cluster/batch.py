"""Many sessions as tasks: progress, and one table of all summaries."""

import logging
import time
from collections.abc import Callable, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from service.errors import CorridorError, StorageError, words_of
from service.extras import install_command, optional
from service.offline.cluster.engines import Engine
from service.offline.cluster.session_task import Task
from service.offline.cluster.tasks import AnyTask, Done
from service.offline.replay.run import MAPPING

log = logging.getLogger(__name__)

TABLE_FILE = "sessions.parquet"
Progress = Callable[[float, str, str], None]  # share of the sessions; the phase; as text
# Column -> type of Arrow, and where summary.json has it
COLUMNS: dict[str, tuple[str, tuple[str, ...]]] = {
    "corridor": ("string", ("corridor",)),
    "profile": ("string", ("profile",)),
    "scans": ("int64", ("scans",)),
    "scans_dropped": ("int64", ("scans_dropped",)),
    "ok": ("int64", ("state", "ok")),
    "degraded": ("int64", ("state", "degraded")),
    "lost": ("int64", ("state", "lost")),
    "loop_closures": ("int64", ("loop_closures",)),
    "keyframes": ("int64", ("keyframes",)),
    "map_tiles": ("int64", ("map_tiles",)),
    "duration_s": ("float64", ("duration_s",)),
    "wall_s": ("float64", ("wall_s",)),
    "realtime_factor": ("float64", ("realtime_factor",)),
    "scan_ms_p50": ("float64", ("scan_ms", "p50")),
    "scan_ms_p99": ("float64", ("scan_ms", "p99")),
    "peak_rss_mb": ("int64", ("peak_rss_mb",)),
}


def run_batch(tasks: Sequence[AnyTask], engine: Engine, progress: Progress) -> list[Done]:
    """Run all; their outcomes in the order of the tasks."""
    done: dict[int, Done] = {}
    began_s = time.monotonic()
    for k, one in engine(tasks):
        done[k] = one
        progress(len(done) / len(tasks), MAPPING, _pace(list(done.values()), len(tasks), began_s))
    if known := sum(one.was_done for one in done.values()):
        log.info(
            "%d of %d sessions are done already, of the same input, config and version; --again repeats them",
            *(known, len(tasks)),
        )
    return [done[k] for k in range(len(tasks))]


def _pace(done: Sequence[Done], count: int, began_s: float) -> str:
    """Rate of the sessions that had to be mapped: the others take no time."""
    mapped = sum(not one.was_done for one in done)
    failed = sum(isinstance(one.outcome, CorridorError) for one in done)
    words = f", {len(done)} of {count} sessions, {failed} failed"
    taken_s = time.monotonic() - began_s
    if not mapped or len(done) == count:
        return words
    left_s = round(taken_s / mapped * (count - len(done)))
    return f"{words}, {60.0 * mapped / taken_s:.3g} a minute, {left_s // 60}:{left_s % 60:02} left"


def write_table(folder: Path, tasks: Sequence[Task], done: Sequence[Done]) -> Path | None:
    """sessions.parquet: a row for each session, by its name. None, with a message, without pyarrow.

    Raises StorageError.
    """
    if find_spec("pyarrow") is None:
        log.info("%s is not written: it needs pyarrow: %s", TABLE_FILE, install_command("cluster"))
        return None
    arrow = optional("pyarrow", "cluster", TABLE_FILE)
    parquet = optional("pyarrow.parquet", "cluster", TABLE_FILE)
    first = {name: arrow.string() for name in ("session", "result", "error")}
    last = {"warnings": arrow.list_(arrow.string()), "input": arrow.list_(arrow.string())}
    types = {name: getattr(arrow, kind)() for name, (kind, _) in COLUMNS.items()}
    rows = sorted(
        (_row(*pair) for pair in zip(tasks, done, strict=True)), key=lambda row: str(row["session"])
    )
    table = arrow.Table.from_pylist(rows, schema=arrow.schema(first | types | last))
    path = folder / TABLE_FILE
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with path.open("wb") as file:
            parquet.write_table(table, file)
    except OSError as error:
        raise StorageError(f"cannot write {path}: {words_of(error)}") from error
    return path


def _row(task: Task, done: Done) -> dict[str, Any]:
    row: dict[str, Any] = {"session": task.name, "input": list(done.manifest.get("input", {}).values())}
    if isinstance(done.outcome, CorridorError):
        return row | {"error": str(done.outcome), "warnings": []}
    for name, (_, keys) in COLUMNS.items():
        value: Any = done.outcome
        for key in keys:
            value = value[key]
        row[name] = value
    return row | {"result": str(task.folder), "warnings": done.outcome["warnings"]}
