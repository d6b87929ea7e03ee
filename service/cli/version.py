"""`corridor --version`: what someone who looks into a fault has to know of the program."""

import argparse
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from service.version import VERSION

ROOT = Path(__file__).parents[2]  # of a checkout; else the folder of all installed packages
GIT_S = 5.0


class ShowVersion(argparse.Action):
    """Prints the words and ends the command."""

    def __init__(self, option_strings: Sequence[str], dest: str, **settings: Any) -> None:
        super().__init__(option_strings, argparse.SUPPRESS, nargs=0, **settings)

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        print(version_words())
        parser.exit()


def version_words() -> str:
    """A line each: the version; of a checkout the commit; the key of the kernels' cache."""
    from service.compile.cache import cache_key, is_warm

    commit = _commit()
    kernels = "all compiled" if is_warm() else "some are compiled when they are needed, or by corridor warmup"
    return "\n".join(
        [f"corridor {VERSION}", *([f"git {commit}"] if commit else []), f"kernels {cache_key()}: {kernels}"]
    )


def _commit() -> str:
    """Of a checkout, with "-dirty" where files differ from it; "" where this is none, or git is not there."""
    if not (ROOT / ".git").exists():
        return ""
    describe = ["git", "-C", str(ROOT), "describe", "--always", "--dirty", "--abbrev=12"]
    try:
        done = subprocess.run(describe, capture_output=True, text=True, timeout=GIT_S, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return done.stdout.strip()
