"""Types of arguments: names, numbers and stored maps; what is none is wrong usage.

Names stand here where importing what they name would take a second; a test holds them against
simulators.worlds and service.mapper.profiles.
"""

import argparse
import difflib
from collections.abc import Sequence
from pathlib import Path
from typing import TypeVar

from service.archive import path_or_url
from service.publishing.keys import NAME_RULE, is_name

METHODS = Path(__file__).parents[1] / "mapper" / "methods"  # a folder for each profile
WORLDS = (
    *("corridor100", "crowd", "featureless", "floor", "glass_corridor", "glass_hall", "hall100", "hall200"),
    *("hall300", "library", "mall", "office", "ring", "room", "spins", "stop_and_go", "t_room"),
)
PROFILES = tuple(sorted(path.parent.name for path in METHODS.glob("*/method.py")))
MOST = 1e9  # seconds, times real time, MB/s: a slip of the finger
Number = TypeVar("Number", int, float)


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


def positive(text: str) -> float:
    value = _number(text, float)
    if not 0.0 < value < MOST:
        raise argparse.ArgumentTypeError(f"{text} is not above 0 and below {MOST:.0e}")
    return value


def positive_int(text: str) -> int:
    value = _number(text, int)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{text} is not above 0")
    return value


def port(text: str) -> int:
    value = _number(text, int)
    if not 1 <= value <= 65535:
        raise argparse.ArgumentTypeError(f"{text} is no port; 1 to 65535")
    return value


def vehicle_name(text: str) -> str:
    if not is_name(text):
        raise argparse.ArgumentTypeError(f"{text!r} is no name of a vehicle; it takes {NAME_RULE}")
    return text


def _number(text: str, kind: type[Number]) -> Number:
    """Without it argparse would name the function that failed."""
    try:
        return kind(text)
    except ValueError as error:
        what = "whole number" if kind is int else "number"
        raise argparse.ArgumentTypeError(f"{text!r} is no {what}") from error


def rate(text: str) -> float:
    """0 stands for as fast as it goes."""
    if text == "max":
        return 0.0
    try:
        return positive(text)
    except argparse.ArgumentTypeError as error:
        raise argparse.ArgumentTypeError(f"{error}; give one, or max") from error


def local_path(text: str) -> Path:
    """Path would make s3:/bucket of s3://bucket, and a command write to a folder of that name."""
    if "://" in text and not text.startswith("file://"):
        raise argparse.ArgumentTypeError(
            f"{text} is a URL; expected a path on this machine. Copy the file: only replay, tune and site "
            "build read recordings by URLs, and only replay --out may be one"
        )
    return path_or_url(text)


def map_and_version(text: str) -> tuple[Path, int | None]:
    """office@12 is version 12 of office; a folder whose name holds an @ is itself."""
    folder, _, version = text.rpartition("@")
    if folder and version.isdigit() and not Path(text).exists():
        return local_path(folder), int(version)
    return local_path(text), None
