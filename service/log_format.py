"""How the service's processes log: to stderr, for the journal or for people."""

import logging
import os
import re
import sys

_CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f]")  # tab and new line are text
_SYSLOG_LEVELS = {"DEBUG": 7, "INFO": 6, "WARNING": 4, "ERROR": 3, "CRITICAL": 2}


def printable(text: object) -> str:
    """Control characters as escapes: names in a file or from the network must not steer a terminal."""
    return _CONTROL.sub(lambda found: found[0].encode("unicode_escape").decode(), str(text))


class PlainFormatter(logging.Formatter):
    """Prints no control characters."""

    def format(self, record: logging.LogRecord) -> str:
        return printable(super().format(record))


class JournalFormatter(PlainFormatter):
    """`<4>text`: systemd's journal takes the number for the severity, and has the time itself."""

    def format(self, record: logging.LogRecord) -> str:
        text = super().format(record).replace("\n", "\n  ")
        return f"<{_SYSLOG_LEVELS.get(record.levelname, 6)}>{text}"


def set_up_logging(level: int) -> None:
    """Log to stderr: for the journal where systemd started us, with times for people elsewhere."""
    handler = logging.StreamHandler(sys.stderr)
    if "JOURNAL_STREAM" in os.environ:
        handler.setFormatter(JournalFormatter("%(name)s: %(message)s"))
    else:
        handler.setFormatter(PlainFormatter("%(asctime)s %(levelname)-7s %(name)s: %(message)s", "%H:%M:%S"))
    logging.basicConfig(level=level, handlers=[handler], force=True)
    logging.getLogger("numba").setLevel(logging.WARNING)
    logging.captureWarnings(True)
