"""What to write instead of a word that is not known."""

import difflib
import math
from collections.abc import Iterable, Sequence

_UNITS: dict[str, tuple[str, float, str]] = {  # suffix -> dimension, size, word
    "ns": ("time", 1e-9, "nanoseconds"),
    "us": ("time", 1e-6, "microseconds"),
    "ms": ("time", 1e-3, "milliseconds"),
    "s": ("time", 1.0, "seconds"),
    "min": ("time", 60.0, "minutes"),
    "h": ("time", 3600.0, "hours"),
    "mm": ("length", 1e-3, "millimetres"),
    "cm": ("length", 1e-2, "centimetres"),
    "m": ("length", 1.0, "metres"),
    "km": ("length", 1e3, "kilometres"),
    "mrad": ("angle", 1e-3, "milliradians"),
    "deg": ("angle", math.radians(1.0), "degrees"),
    "rad": ("angle", 1.0, "radians"),
    "kb": ("size", 1e-3, "kilobytes"),
    "mb": ("size", 1.0, "megabytes"),
    "gb": ("size", 1e3, "gigabytes"),
    "hz": ("rate", 1.0, "hertz"),
    "khz": ("rate", 1e3, "kilohertz"),
}


def suggest(word: str, known: Iterable[str]) -> str:
    """A clause for a message: the known word that is spelt most alike, else all of them."""
    known = list(known)
    if near := difflib.get_close_matches(word, known, n=1):
        return f'did you mean "{near[0]}"?'
    return f"known here: {', '.join(known)}"


def unknown_key(key: str, value: object, known: Sequence[str]) -> str:
    """A fault of a config: what was meant by a key, or by its value in another unit."""
    return f"unknown key; {_other_unit(key, value, known) or suggest(key, known)}"


def _other_unit(key: str, value: object, known: Sequence[str]) -> str:
    """Advice where `timeout_ms` stands for `timeout_s`, with the value converted; "" where that is not it."""
    stem, _, unit = key.lower().rpartition("_")
    if unit not in _UNITS:
        stem, unit = key.lower(), ""
    units = {other: other.rpartition("_")[2] for other in known if other.rpartition("_")[0] == stem}
    alike = {other: _UNITS[its] for other, its in units.items() if its in _UNITS}
    same = {other: its for other, its in alike.items() if unit and its[0] == _UNITS[unit][0]}
    advice = " or ".join(f'"{other}", in {word}' for other, (_, _, word) in (same or alike).items())
    for other, (_, size, _) in same.items():
        if isinstance(value, int | float):
            advice += f"; write {other}: {value * _UNITS[unit][1] / size:.10g}"
    return advice and f"this setting is {advice}"
