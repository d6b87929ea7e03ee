"""Shared by the client scripts: reading the facts, reporting a fault, reporting the values seen."""

import json
import sys
from pathlib import Path
from typing import Any


def facts() -> dict[str, Any]:
    """The truth, from the file named on the command line."""
    return json.loads(Path(sys.argv[1]).read_text())


def expect(holds: bool, words: str) -> None:
    """Exit with a message where a condition does not hold."""
    if not holds:
        raise SystemExit(words)


def report(**seen: Any) -> None:
    """Prints the last line of stdout."""
    print(json.dumps(seen), flush=True)
