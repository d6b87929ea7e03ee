"""Access to the page: for viewing, and for changes.

Viewing needs no token; changes do. A browser on another site's page is refused by Host and Origin: a
name that leads to this machine by DNS rebinding is not in the list, and an address cannot be rebound.
"""

import hmac
import ipaddress
import os
import secrets
import socket
from collections.abc import Collection
from pathlib import Path
from urllib.parse import urlsplit

from service.errors import StorageError, words_of
from service.private_file import read_private

TOKEN_BYTES = 16
LONGEST_TOKEN_FILE = 1000

HEADERS = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; connect-src 'self'; "
        "manifest-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-cache",
}


def new_token() -> str:
    return secrets.token_urlsafe(TOKEN_BYTES)


def state_folder() -> Path:
    """STATE_DIRECTORY of systemd, else corridor/ in the user's folder of state (XDG)."""
    if given := os.environ.get("STATE_DIRECTORY", "").partition(":")[0]:
        return Path(given)
    return Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state") / "corridor"


def token_from_file(path: Path) -> str:
    """The token kept there, made at the first call, readable for its owner alone.

    Raises StorageError where the file cannot be made or read, is empty, or others may read it.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.exists():
            return _kept_token(path)
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    except OSError as error:
        raise StorageError(
            f"{path}: the token of the page cannot be kept there: {words_of(error)}"
        ) from error
    token = new_token()
    with os.fdopen(descriptor, "w", encoding="ascii") as file:
        file.write(f"{token}\n")
    return token


def _kept_token(path: Path) -> str:
    content = read_private(path, "the token of the page", LONGEST_TOKEN_FILE)
    if not content.isascii():
        raise StorageError(f"{path}: the token of the page cannot be read: it is no text of ASCII")
    if not (token := content.decode().strip()):
        raise StorageError(f"{path}: empty; remove it, and the next start writes a token into it")
    return token


def is_token(shown: str, token: str) -> bool:
    """Takes as long for a wrong token as for a valid one."""
    return hmac.compare_digest(shown.encode(), token.encode())


def own_names(hosts: Collection[str]) -> frozenset[str]:
    """Names by which this machine may be called besides its addresses."""
    name = socket.gethostname().lower()
    return frozenset(("localhost", name, f"{name}.local", *hosts))


def host_fault(host: str, names: Collection[str]) -> str:
    """Fault of a Host header, "" if there is none. Any port: it may have been forwarded."""
    name = _host_name(host)
    if name in names or _is_address(name):
        return ""
    return f"this page is not called {name!r}; open it by its IP address, or list the name under web.hosts"


def origin_fault(origin: str | None, host: str, scheme: str) -> str:
    """Fault of the Origin header of a websocket, "" if there is none. Programs send none."""
    if origin is None:
        return ""
    if origin.lower() != f"{scheme}://{host.lower()}":
        return f"the page {origin!r} may not speak to this service; open the page of the service itself"
    return ""


def _host_name(host: str) -> str:
    try:
        return (urlsplit(f"//{host}").hostname or "").lower()
    except ValueError:
        return ""


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True
