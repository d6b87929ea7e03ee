"""Tokens of the page: their names, roles and ends.

The service's own token is in a file that it makes. Further ones, for people, are made and revoked by
`corridor security token`: their digests are in a file beside it, which is read again when it changes.
"""

import hashlib
import json
import logging
import time
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, TypeAdapter, ValidationError

from drivers.section import Section
from service.errors import InputError, StorageError, words_of
from service.private_file import read_private, write_whole
from service.web.access import is_token, new_token

log = logging.getLogger(__name__)

Role = Literal["viewer", "operator"]
MAX_FILE_BYTES = 1_000_000
WINDOW_S = 60.0  # for which wrong tokens of an address count
FREE_ATTEMPTS = 5  # in that time; each further one waits
WAIT_S = 1.0
LONGEST_WAIT_S = 30.0
MAX_ADDRESSES = 1000


class Grant(Section):
    """Name, role and end of the token with this digest."""

    name: Annotated[str, Field(min_length=1, max_length=64)]
    role: Role
    sha256: Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
    expires_unix_s: float | None = None

    def holds(self, unix_s: float) -> bool:
        return self.expires_unix_s is None or unix_s < self.expires_unix_s


_GRANTS = TypeAdapter(tuple[Grant, ...])


def granted_beside(token_file: Path) -> Path:
    """File of the further tokens of a service whose own is in `token_file`."""
    return token_file.with_name(f"{token_file.name}s.json")


def read_grants(path: Path) -> tuple[Grant, ...]:
    """Raises StorageError where it cannot be read or others may write it, InputError where it is damaged."""
    try:
        text = read_private(path, "the further tokens", MAX_FILE_BYTES)
    except StorageError as error:
        if isinstance(error.__cause__, FileNotFoundError):
            return ()
        raise
    try:
        return _GRANTS.validate_json(text)
    except ValidationError as error:
        why = error.errors()[0]["msg"]
        raise InputError(f"{path}: no tokens of corridor: {why}; remove the file") from error


def add_grant(path: Path, name: str, role: Role, expires_unix_s: float | None) -> str:
    """The new token, which is kept nowhere; one of that name before is revoked. Raises as read_grants."""
    token = new_token()
    grant = Grant(name=name, role=role, sha256=_digest(token), expires_unix_s=expires_unix_s)
    _write(path, (*(one for one in read_grants(path) if one.name != name), grant))
    return token


def revoke_grant(path: Path, name: str) -> None:
    """Raises InputError where there is none of that name, and as read_grants."""
    grants = read_grants(path)
    left = tuple(one for one in grants if one.name != name)
    if left == grants:
        known = ", ".join(one.name for one in grants) or "none"
        raise InputError(f"{path}: no token of {name}; there are: {known}")
    _write(path, left)


class Tokens:
    """Checks tokens; for one event loop.

    own       token of the service itself
    granted   file of the further ones; None: there are none
    """

    def __init__(
        self, own: str, granted: Path | None = None, unix_s: Callable[[], float] = time.time
    ) -> None:
        self.fault = ""  # why the further tokens are refused, "" if they are not
        self._own = own
        self._owner = Grant(name="the service's own token", role="operator", sha256=_digest(own))
        self._granted = granted
        self._unix_s = unix_s
        self._seen: tuple[int, int, int] | None = None  # state of the file as it was read
        self._grants: tuple[Grant, ...] = ()

    def grant_of(self, shown: str) -> Grant | None:
        """Takes as long for a wrong token as for a right one."""
        if is_token(shown, self._own):
            return self._owner
        digest = _digest(shown)
        found = [one for one in self._read() if is_token(digest, one.sha256)]
        return found[0] if found and found[0].holds(self._unix_s()) else None

    def still_holds(self, grant: Grant) -> bool:
        """False once it is revoked or has expired."""
        return grant is self._owner or (grant in self._read() and grant.holds(self._unix_s()))

    def _read(self) -> tuple[Grant, ...]:
        if self._granted is None:
            return ()
        try:
            found = self._granted.stat()
            seen = found.st_ctime_ns, found.st_size, found.st_ino
        except OSError:
            seen = 0, 0, 0
        if seen != self._seen:
            self._seen, self._grants, self.fault = seen, (), ""
            try:
                self._grants = read_grants(self._granted)
            except (StorageError, InputError) as error:
                self.fault = str(error)
                log.error("web: further tokens are refused: %s", error)
        return self._grants


class Attempts:
    """Wrong tokens by address: the more in a minute, the later each is answered. A right one never waits."""

    def __init__(self, monotonic_s: Callable[[], float] = time.monotonic) -> None:
        self._monotonic_s = monotonic_s
        self._of: OrderedDict[str, tuple[int, float, float]] = OrderedDict()  # count, since, next answer

    def wrong(self, address: str) -> float:
        """Count one; the time in s after which it is answered."""
        now_s = self._monotonic_s()
        count, since_s, next_s = self._of.pop(address, (0, now_s, now_s))
        if now_s - since_s > WINDOW_S:
            count, since_s = 0, now_s
        count += 1
        next_s = max(next_s, now_s) + (WAIT_S if count > FREE_ATTEMPTS else 0.0)
        self._of[address] = count, since_s, min(next_s, now_s + LONGEST_WAIT_S)
        if len(self._of) > MAX_ADDRESSES:
            self._of.popitem(last=False)
        if count & (count - 1) == 0:  # 1, 2, 4, 8 ...: a guesser does not fill the log
            log.warning("web: wrong token from %s, %d in %.0f s", address, count, now_s - since_s)
        return self._of[address][2] - now_s


def _digest(token: str) -> str:
    """Of 128 random bits: they need no salt."""
    return hashlib.sha256(token.encode()).hexdigest()


def _write(path: Path, grants: tuple[Grant, ...]) -> None:
    text = json.dumps([one.model_dump() for one in grants], indent=1)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, f"{text}\n".encode(), is_of_folder=True)
    except OSError as error:
        raise StorageError(f"{path}: the tokens cannot be written: {words_of(error)}") from error
