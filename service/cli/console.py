"""What the commands say: progress and logs on stderr, results on stdout."""

import json
import math
import sys
import time
from collections.abc import Iterator
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
    """How far a long work has come, 0 to 1: a bar on a terminal, a line each tenth elsewhere."""

    def __init__(self, what: str, stream: TextIO | None = None) -> None:
        self._what = what
        self._stream = stream if stream is not None else sys.stderr
        self._terminal = self._stream.isatty()
        self._drawn_s = 0.0
        self._plain_step = 0

    def __call__(self, share: float) -> None:
        share = min(max(share, 0.0), 1.0)
        if self._terminal:
            now_s = time.monotonic()
            if now_s - self._drawn_s >= REDRAW_S or share == 1.0:
                self._drawn_s = now_s
                filled = round(share * BAR_WIDTH)
                bar = "#" * filled + "." * (BAR_WIDTH - filled)
                self._stream.write(f"\r{self._what} [{bar}] {share:4.0%}")
                self._stream.flush()
        elif (step := math.floor(share * PLAIN_STEPS + 1e-9)) > self._plain_step:
            self._plain_step = step
            self._stream.write(f"{self._what}: {step / PLAIN_STEPS:.0%}\n")
            self._stream.flush()

    def end(self) -> None:
        """Leave the bar's line."""
        if self._terminal and self._drawn_s > 0.0:
            self._stream.write("\n")
            self._stream.flush()


@contextmanager
def progress(what: str) -> Iterator[Progress]:
    """A Progress that leaves its line however the work ends."""
    shown = Progress(what)
    try:
        yield shown
    finally:
        shown.end()
