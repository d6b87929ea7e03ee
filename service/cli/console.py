"""Output of the commands: progress and logs on stderr, results on stdout."""

import json
import math
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from typing import TYPE_CHECKING, Any, TextIO

from service.log_format import printable

if TYPE_CHECKING:  # it imports numba
    from service.compile.warm_up import KernelProgress

BAR_WIDTH = 30
CLEAR = "\r\x1b[K"  # to the first column; what stands on the line goes
REDRAW_S = 0.1
PLAIN_STEPS = 10  # off a terminal a line each tenth
SILENCE_S = 5.0  # the longest
PACE_S = 2.0  # of a phase; sooner no one knows how long it takes


def print_result(result: dict[str, Any], as_json: bool) -> None:
    """The result of a command: one JSON object, or one `name: value` a line, without what is None."""
    if as_json:
        print(json.dumps(result, allow_nan=False))
    else:
        print(printable("\n".join(_lines(result, ""))))


def print_report(report: Any, as_json: bool) -> None:
    """A dataclass that can be printed: its fields as one JSON object, or its words."""
    if as_json:
        print(json.dumps(_as_json(report), allow_nan=False, default=str))
    else:
        print(printable(report))


def _as_json(value: Any) -> Any:
    """Dataclasses and named tuples as objects, at any depth.

    Not dataclasses.asdict, which of a Counter makes one of its pairs (Python 3.11).
    """
    if is_dataclass(value):
        return {one.name: _as_json(getattr(value, one.name)) for one in fields(value)}
    if isinstance(value, tuple) and hasattr(value, "_asdict"):
        return _as_json(value._asdict())
    if isinstance(value, Mapping):
        return {key: _as_json(part) for key, part in value.items()}
    return [_as_json(part) for part in value] if isinstance(value, list | tuple) else value


def _lines(result: dict[str, Any], prefix: str) -> Iterator[str]:
    for key, value in result.items():
        if isinstance(value, list) and value and isinstance(value[0], dict):
            value = {str(number): one for number, one in enumerate(value, 1)}
        if isinstance(value, dict) and value:
            yield from _lines(value, f"{prefix}{key}.")
        elif value is not None:
            yield f"{prefix}{key}: {_shown(value)}"


def _shown(value: Any) -> str:
    match value:
        case bool():
            return "yes" if value else "no"
        case float():
            return f"{value:.6g}"
        case list() | tuple() | dict():
            return ", ".join(map(_shown, value)) or "none"
    return str(value)


class Progress:
    """How far a long work has come, phase by phase: a bar on a terminal, a line each tenth elsewhere.

    Threads may tell at the same time. A phase of which no one knows how far it is, is only named.
    """

    def __init__(
        self, what: str, stream: TextIO | None = None, monotonic_s: Callable[[], float] = time.monotonic
    ) -> None:
        self._phase = what
        self._stream = stream if stream is not None else sys.stderr
        self._monotonic_s = monotonic_s
        self._terminal = self._stream.isatty()
        self._lock = threading.Lock()
        self._is_line_open = self._has_begun = False
        self._share: float | None = None
        self._note = ""
        self._phase_began_s = monotonic_s()
        self._written_s = -math.inf
        self._plain_steps: dict[str, int] = {}  # reported so far, by phase

    def __call__(self, share: float | None, phase: str = "", note: str = "") -> None:
        """share    of the phase, 0 to 1; None: not known
        phase    left out: that of before
        note     stands behind the share, in the place of rate and time left
        """
        with self._lock:
            if is_new := phase not in ("", self._phase):
                self._leave_line()
                self._phase, self._phase_began_s, self._written_s = phase, self._monotonic_s(), -math.inf
            self._has_begun = True
            self._note = note
            self._share = None if share is None else min(max(share, 0.0), 1.0)
            if self._terminal:
                if is_new or self._share == 1.0 or self._quiet_s() >= REDRAW_S:
                    self._write(f"{CLEAR}{self._line()}")
            elif self._share is None:
                if is_new:
                    self._write(f"{self._phase} ...\n")
            elif (step := math.floor(self._share * PLAIN_STEPS + 1e-9)) > self._plain_steps.get(phase, 0):
                self._plain_steps[phase] = step
                self._write(f"{self._phase}: {step / PLAIN_STEPS:.0%}{note}\n")

    def still_at_work(self) -> None:
        """Show since when the phase lasts, where nothing was written for SILENCE_S."""
        with self._lock:
            if self._has_begun and self._quiet_s() >= SILENCE_S:
                line = f"{self._line()}, {self._monotonic_s() - self._phase_began_s:.0f} s"
                self._write(f"{CLEAR}{line}" if self._terminal else f"{line}\n")

    def end(self) -> None:
        """Leave the bar's line."""
        with self._lock:
            self._leave_line()

    def _line(self) -> str:
        if self._share is None:
            return f"{self._phase} ..."
        if not self._terminal:
            return f"{self._phase}: {self._share:.0%}{self._note}"
        return f"{self._phase} {bar(self._share)}{self._note or self._pace()}"

    def _pace(self) -> str:
        """Rate of the phase so far and the time that the rest takes at it, once some seconds show it."""
        taken_s = self._monotonic_s() - self._phase_began_s
        if not self._share or self._share == 1.0 or taken_s < PACE_S:
            return ""
        left_s = round(taken_s * (1.0 - self._share) / self._share)
        return f", {100.0 * self._share / taken_s:.2g} %/s, {left_s // 60}:{left_s % 60:02} left"

    def _quiet_s(self) -> float:
        return self._monotonic_s() - self._written_s

    def _leave_line(self) -> None:
        if self._is_line_open:
            self._write("\n")

    def _write(self, text: str) -> None:
        self._is_line_open, self._written_s = not text.endswith("\n"), self._monotonic_s()
        self._stream.write(text)
        self._stream.flush()


def bar(share: float) -> str:
    """Share of a work, 0 to 1, as `[####......]  40%`."""
    filled = round(share * BAR_WIDTH)
    return f"[{'#' * filled}{'.' * (BAR_WIDTH - filled)}] {share:4.0%}"


@contextmanager
def progress(what: str) -> Iterator[Progress]:
    """A Progress that is never silent for long, and leaves its line however the work ends."""
    shown = Progress(what)
    ended = threading.Event()

    def remind() -> None:
        while not ended.wait(SILENCE_S):
            shown.still_at_work()

    reminder = threading.Thread(target=remind, name="progress", daemon=True)
    reminder.start()
    try:
        yield shown
    finally:
        ended.set()
        reminder.join()
        shown.end()


@contextmanager
def kernel_progress() -> Iterator["KernelProgress"]:
    """Shows how many kernels are compiled, if any must be."""
    from service.compile.warm_up import KernelProgress

    with progress("compiling kernels") as shown:
        yield KernelProgress(lambda kernels: shown(kernels.share))


def print_table(rows: Sequence[Sequence[str]]) -> None:
    """Columns under their heads, the first row; words to the left, figures to the right."""
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    for row in rows:
        cells = [
            cell.ljust(width) if column == 0 or not _is_figure(rows[-1][column]) else cell.rjust(width)
            for column, (cell, width) in enumerate(zip(row, widths, strict=True))
        ]
        print(printable("  ".join(cells).rstrip()))


def _is_figure(cell: str) -> bool:
    return cell[:1].isdigit() or cell == "-"
