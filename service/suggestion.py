"""What to write instead of a word that is not known."""

import difflib
from collections.abc import Iterable


def suggest(word: str, known: Iterable[str]) -> str:
    """A clause for a message: the known word that is spelt most alike, else all of them."""
    known = list(known)
    if near := difflib.get_close_matches(word, known, n=1):
        return f'did you mean "{near[0]}"?'
    return f"known here: {', '.join(known)}"
