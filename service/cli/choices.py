"""Names that a command line takes, where importing what they name would take a second.

A test holds them against simulators.worlds and service.mapper.profiles.
"""

import argparse
import difflib
from collections.abc import Sequence
from pathlib import Path

METHODS = Path(__file__).parents[1] / "mapper" / "methods"  # a folder for each profile
WORLDS = (
    *("corridor100", "crowd", "featureless", "floor", "glass_corridor", "glass_hall", "hall100", "hall200"),
    *("hall300", "library", "mall", "office", "ring", "room", "spins", "stop_and_go", "t_room"),
)
PROFILES = tuple(sorted(path.parent.name for path in METHODS.glob("*/method.py")))


class OneOf:
    """An argument's `type`: the name itself, or a sentence that lists the choices."""

    def __init__(self, what: str, known: Sequence[str]) -> None:
        self._what = what
        self.known = known  # for completion

    def __call__(self, name: str) -> str:
        if name in self.known:
            return name
        near = difflib.get_close_matches(name, self.known, n=1)
        meant = f"did you mean {near[0]}? " if near else ""
        raise argparse.ArgumentTypeError(
            f"no {self._what} {name!r}; {meant}there are {', '.join(self.known)}"
        )
