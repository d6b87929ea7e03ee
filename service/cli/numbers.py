"""Types of arguments that are numbers: what is none, or out of range, is wrong usage."""

import argparse
from typing import TypeVar

MOST = 1e9  # seconds, times real time, MB/s: a slip of the finger
Number = TypeVar("Number", int, float)


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
