"""Errors of drivers. One base, three kinds, one reaction each.

    DriverError
     |- TransportError   the bytes stopped: refused, reset, silent       -> reconnect
     |- ProtocolError    the bytes are not the protocol                  -> drop the link, fresh session
     `- DeviceError      the device understood and refused, or reports a fault
                                                                         -> report, retry at long intervals

A message says what was measured, what was expected and what to look at; the link adds the sensor's name
and what happens next.
"""


class DriverError(Exception):
    """Base of everything a driver raises on purpose."""


class TransportError(DriverError):
    """The bytes stopped: refused, reset, timed out. Reaction: reconnect."""


class ProtocolError(DriverError):
    """The bytes are not the protocol. Reaction: drop the link, start a new session."""


class DeviceError(DriverError):
    """The device understood us and refused. Reaction: report; retry seldom, somebody has to mend it."""
