"""Text that devices report, made safe for a log, a status and an error."""

MAX_CHARS = 80  # the longest name in docs and recordings, MODL of a URG-04LX, has 37


def one_line(text: str) -> str:
    """The text without what would begin another line of a log or steer a terminal: each character that cannot
    be printed is a question mark, blanks at the ends are left out, and so is what goes beyond MAX_CHARS."""
    return "".join(char if char.isprintable() else "?" for char in text.strip())[:MAX_CHARS]
