"""Names that a command line takes, where importing what they name would take a second.

A test holds them against simulators.worlds and service.mapper.profiles.
"""

import argparse
import difflib
from collections.abc import Callable, Sequence

WORLDS = (
    *("corridor100", "crowd", "featureless", "floor", "glass_corridor", "glass_hall", "hall100", "hall200"),
    *("hall300", "library", "mall", "office", "ring", "room", "spins", "stop_and_go", "t_room"),
)
PROFILES = ("corridor", "contour_lm", "imle", "owolm_eskf", "submap_graph")


def one_of(what: str, known: Sequence[str]) -> Callable[[str], str]:
    """For an argument's `type`: the name itself, or a sentence that says which there are."""

    def check(name: str) -> str:
        if name in known:
            return name
        near = difflib.get_close_matches(name, known, n=1)
        meant = f"did you mean {near[0]}? " if near else ""
        raise argparse.ArgumentTypeError(f"no {what} {name!r}; {meant}there are {', '.join(known)}")

    return check
