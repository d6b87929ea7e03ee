"""What the commands say: progress and logs on stderr, results on stdout."""

import json
import math
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from typing import Any, TextIO

BAR_WIDTH = 30
REDRAW_S = 0.1
PLAIN_STEPS = 10  # off a terminal a line each tenth


def print_result(result: dict[str, Any], as_json: bool) -> None:
    """The result of a command: one JSON object, or one `name: value` a line."""
    if as_json:
        print(json.dumps(result, allow_nan=False))
    else:
        print("\n".join(_lines(result, "")))


def print_report(report: Any, as_json: bool) -> None:
    """A dataclass that knows how to say itself: its fields as one JSON object, or its words."""
    if as_json:
        print(json.dumps(asdict(report), allow_nan=False, default=str))
    else:
        print(report)


def _lines(result: dict[str, Any], prefix: str) -> Iterator[str]:
    for key, value in result.items():
        if isinstance(value, dict) and value:
            yield from _lines(value, f"{prefix}{key}.")
        else:
            shown = f"{value:.6g}" if isinstance(value, float) else value
            yield f"{prefix}{key}: {shown}"


class Progress:
    """How far a long work has come, phase by phase: a bar on a terminal, a line each tenth elsewhere.

    Threads may tell at the same time. A phase of which nobody knows how far it is, is only named.
    """

    def __init__(self, what: str, stream: TextIO | None = None) -> None:
        self._phase = what
        self._stream = stream if stream is not None else sys.stderr
        self._terminal = self._stream.isatty()
        self._lock = threading.Lock()
        self._is_line_open = False
        self._drawn_s = -math.inf
        self._plain_steps: dict[str, int] = {}  # told so far, by phase

    def __call__(self, share: float | None, phase: str = "") -> None:
        """share    of the phase, 0 to 1; None: not known
        phase    left out: that of before
        """
        with self._lock:
            if begins := phase not in ("", self._phase):
                self._begin(phase)
            if share is None:
                if begins:
                    self._write(f"{self._phase} ..." if self._terminal else f"{self._phase} ...\n")
            elif self._terminal:
                self._draw(min(max(share, 0.0), 1.0))
            elif (step := math.floor(min(share, 1.0) * PLAIN_STEPS + 1e-9)) > self._plain_steps.get(phase, 0):
                self._plain_steps[phase] = step
                self._write(f"{self._phase}: {step / PLAIN_STEPS:.0%}\n")

    def end(self) -> None:
        """Leave the bar's line."""
        with self._lock:
            if self._terminal and self._is_line_open:
                self._write("\n")

    def _begin(self, phase: str) -> None:
        if self._terminal and self._is_line_open:
            self._write("\n")
        self._phase, self._drawn_s = phase, -math.inf

    def _draw(self, share: float) -> None:
        now_s = time.monotonic()
        if now_s - self._drawn_s < REDRAW_S and share < 1.0:
            return
        self._drawn_s = now_s
        filled = round(share * BAR_WIDTH)
        self._write(f"\r{self._phase} [{'#' * filled}{'.' * (BAR_WIDTH - filled)}] {share:4.0%}")

    def _write(self, text: str) -> None:
        self._is_line_open = not text.endswith("\n")
        self._stream.write(text)
        self._stream.flush()


@contextmanager
def progress(what: str) -> Iterator[Progress]:
    """A Progress that leaves its line however the work ends."""
    shown = Progress(what)
    try:
        yield shown
    finally:
        shown.end()


def print_table(rows: Sequence[Sequence[str]]) -> None:
    """Columns under their heads, the first row; words to the left, figures to the right."""
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    for row in rows:
        cells = [
            cell.ljust(width) if column == 0 or not _is_figure(rows[-1][column]) else cell.rjust(width)
            for column, (cell, width) in enumerate(zip(row, widths, strict=True))
        ]
        print("  ".join(cells).rstrip())


def _is_figure(cell: str) -> bool:
    return cell[:1].isdigit() or cell == "-"
