"""What every client script shares: the facts it is given, how it reports a fault, how it says what it saw."""

import json
import sys
from pathlib import Path
from typing import Any


def facts() -> dict[str, Any]:
    """The truth, from the file named on the command line."""
    return json.loads(Path(sys.argv[1]).read_text())


def expect(holds: bool, words: str) -> None:
    """End with words where something is not as it should be."""
    if not holds:
        raise SystemExit(words)


def tell(**seen: Any) -> None:
    """The last line of stdout."""
    print(json.dumps(seen), flush=True)
