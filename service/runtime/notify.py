"""Messages to systemd: READY, WATCHDOG, STATUS, STOPPING (sd_notify(3)). None without systemd."""

import logging
import os
import socket
from collections.abc import Mapping

from service.errors import words_of

log = logging.getLogger(__name__)

SEND_TIMEOUT_S = 0.2


class Notifier:
    """Sends to $NOTIFY_SOCKET. Where it is missing, that is logged once, and each message tries
    it again, because a watchdog without messages kills the service.
    """

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        self._socket: socket.socket | None = None
        self.watchdog_s = _watchdog_s(environment)  # ping at least this often; None: no watchdog
        self._address = environment.get("NOTIFY_SOCKET", "")
        self._is_reported = False  # that it is gone, since it was last there
        if self._address:
            self._connect()

    def ready(self) -> None:
        self.send("READY=1")

    def alive(self) -> None:
        self.send("WATCHDOG=1")

    def status(self, line: str) -> None:
        """One line for `systemctl status`."""
        self.send(f"STATUS={line}")

    def need_more_time(self, seconds: float) -> None:
        """Start-up or shutdown goes on; do not give up for `seconds` from now."""
        self.send(f"EXTEND_TIMEOUT_USEC={round(seconds * 1e6)}")

    def stopping(self) -> None:
        self.send("STOPPING=1")

    def send(self, line: str) -> None:
        if self._socket is None and not (self._address and self._connect()):
            return
        assert self._socket is not None
        try:
            self._socket.send(line.encode())
            self._is_reported = False
        except TimeoutError:
            log.warning("systemd does not take %s", line)  # its queue is full
        except OSError as error:
            self._tell(f"cannot notify systemd at NOTIFY_SOCKET={self._address}: {words_of(error)}")
            self._disconnect()

    def close(self) -> None:
        """Nothing more is reported."""
        self._address = ""
        self._disconnect()

    def _connect(self) -> bool:
        address = "\0" + self._address[1:] if self._address.startswith("@") else self._address
        notify = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
        try:
            notify.connect(address)
        except OSError as error:
            notify.close()
            self._tell(
                f"NOTIFY_SOCKET is set to {self._address!r}, but nothing receives there: {words_of(error)}"
            )
            return False
        notify.settimeout(SEND_TIMEOUT_S)
        self._socket = notify
        return True

    def _disconnect(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _tell(self, words: str) -> None:
        log.log(logging.DEBUG if self._is_reported else logging.WARNING, "%s; it is tried again", words)
        self._is_reported = True


def _watchdog_s(environment: Mapping[str, str]) -> float | None:
    """Half of what systemd allows; None where it does not watch this very process."""
    if environment.get("WATCHDOG_PID", str(os.getpid())) != str(os.getpid()):
        return None
    try:
        allowed_us = int(environment.get("WATCHDOG_USEC", "0"))
    except ValueError:
        log.warning("WATCHDOG_USEC=%r is no number; no watchdog", environment["WATCHDOG_USEC"])
        return None
    return allowed_us / 2e6 if allowed_us > 0 else None
