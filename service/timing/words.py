"""Durations and shares in words for people."""

import re

DAY_S = 86_400.0  # above, a time is given in days, too
_NUMBER = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d+)?")  # and not the 2 of a sensor called front_2


def kind_of(words: str) -> str:
    """The same for words that differ in their numbers alone."""
    return _NUMBER.sub("#", words)


def seconds(duration_ns: int) -> str:
    """With its sign where it is below 0; of days also in these."""
    s = duration_ns * 1e-9
    return f"{s:.3f} s" + (f" ({s / DAY_S:.1f} days)" if abs(s) >= DAY_S else "")


def share(part: int, total: int) -> str:
    """ "9 of 89 (10.1 %)" """
    return f"{part} of {total} ({100.0 * part / total:.1f} %)"
