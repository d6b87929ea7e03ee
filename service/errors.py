"""What the service raises on purpose, and the exit code each becomes.

    CorridorError      1   failed
     |- CalledOffError     a signal came before the service was ready: 130 for Ctrl-C, else 0
     |- UsageError    64   the command was called wrongly
     |- InputError    65   a file that was handed in cannot be what it claims to be
     |- StorageError  74   the disk or the network refused: full, no rights, port taken
     `- ConfigError   78   the configuration is wrong; starting again cannot help

The numbers are those of sysexits.h, so systemd and shell scripts can tell them apart. A message says who,
what was found, what was expected and what to do. What a device does wrong stands in drivers.errors and never
ends the service.
"""

import re
import signal
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # the command line would wait for it
    from pydantic import ValidationError


class CorridorError(Exception):
    """Base of everything the service raises on purpose."""

    exit_code = 1

    def __init__(self, words: str) -> None:
        super().__init__(shortened(words))


class CalledOffError(CorridorError):
    """A signal ended a start before the service was ready.

    exit_code   130 for Ctrl-C; 0 where a service manager asked for it, since nothing is left undone
    """

    def __init__(self, number: signal.Signals) -> None:
        super().__init__(f"the start was called off by {number.name}")
        self.exit_code = 128 + number if number == signal.SIGINT else 0


class UsageError(CorridorError):
    """The command was called wrongly."""

    exit_code = 64


class InputError(CorridorError):
    """A recording, log, map or trajectory that cannot be read as what it was given for."""

    exit_code = 65


class StorageError(CorridorError):
    """The disk or the network refused."""

    exit_code = 74


class ConfigError(CorridorError):
    """A configuration with one or more faults, all of them listed.

    faults    one line each: `file:line:column: path: what is wrong, what to write instead`
    """

    exit_code = 78

    def __init__(self, faults: list[str]) -> None:
        self.faults = [shortened(fault) for fault in faults]
        super().__init__("\n".join(self.faults))

    def __reduce__(self) -> tuple[type["ConfigError"], tuple[list[str]]]:
        """To come from another process: not made of the joined lines, as other exceptions are."""
        return type(self), (self.faults,)


def shortened(message: str) -> str:
    """With words cut off that are longer than the name of a file may be: what is refused, mostly."""
    return re.sub(r"\S{256,}", lambda found: f"{found[0][:80]}...", message)


def fault_words(error: "ValidationError") -> str:
    """Where the first fault lies and what it is: `path.to.field: words`."""
    fault = error.errors(include_url=False, include_input=False)[0]
    words = fault["msg"].removeprefix("Value error, ")
    return f"{'.'.join(map(str, fault['loc']))}: {words}" if fault["loc"] else words


def words_of(error: BaseException) -> str:
    """What it says, without the number and the path that Python adds to what the system says."""
    return error.strerror if isinstance(error, OSError) and error.strerror else str(error)
