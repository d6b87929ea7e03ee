"""Errors of drivers. One base, four kinds, one reaction each.

    DriverError
     |- TransportError   the bytes stopped: refused, reset, silent       -> reconnect
     |- ProtocolError    the bytes are not the protocol                  -> drop the link, fresh session
     |- DeviceError      the device understood and refused, or reports a fault
     |                                                                   -> report, retry at long intervals
     `- UnforeseenError  an exception that the driver did not foresee     -> the same, with the traceback

A message gives the measured and the expected value and the remedy; the link adds the sensor's name
and what happens next.
"""

from collections.abc import Callable
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
T = TypeVar("T")


class DriverError(Exception):
    """Base of everything a driver raises on purpose, and of what `contained` makes of the rest."""


class TransportError(DriverError):
    """The bytes stopped: refused, reset, timed out. Reaction: reconnect."""


class ProtocolError(DriverError):
    """The bytes are not the protocol. Reaction: drop the link, start a new session."""


class DeviceError(DriverError):
    """The device refused. Reaction: report, and retry every 10 s; a person has to act."""


class UnforeseenError(DriverError):
    """A fault of a driver; the cause is the exception. Reaction: as to a DeviceError."""


def contained(call: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
    """Result of a driver's function. Raises DriverError alone: an UnforeseenError for every exception that
    the driver did not raise on purpose, so that one sensor's bytes cannot end the service of all."""
    try:
        return call(*args, **kwargs)
    except DriverError:
        raise
    except Exception as error:
        raise UnforeseenError(
            f"the driver failed: {type(error).__name__}: {str(error)[:200]}; this is a mistake of corridor: "
            "report it, with the traceback in the log of `corridor run`"
        ) from error
