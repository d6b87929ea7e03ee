"""Places at the page; a share of them is reserved for browsers that have shown a token."""

import ipaddress
from collections import Counter
from collections.abc import Collection
from typing import Protocol, TypeVar

SHARE_RESERVED = 4  # a quarter of the places
SHARE_OF_ADDRESS = 3  # of the rest, a third for one address


class Seated(Protocol):
    """A browser at the page."""

    @property
    def address(self) -> str: ...
    @property
    def is_guest(self) -> bool: ...  # it has shown no token
    @property
    def must_show(self) -> bool: ...  # a token, soon


SeatedT = TypeVar("SeatedT", bound=Seated)


class Seats:
    """most: places in all."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._for_guests = most - most // SHARE_RESERVED
        self._of_address = max(1, self._for_guests // SHARE_OF_ADDRESS)

    def must_show(self, seated: Collection[Seated], address: str) -> bool:
        """Whether a newcomer has a place for a moment only, unless it shows a token.

        Programs of this machine may be many behind a proxy: no limit for each.
        """
        staying = Counter(one.address for one in seated if one.is_guest and not one.must_show)
        return staying.total() >= self._for_guests or (
            staying[address] >= self._of_address and not _is_loopback(address)
        )

    def has_place(self, seated: Collection[Seated]) -> bool:
        return len(seated) < self._most

    def to_leave(self, seated: Collection[SeatedT]) -> SeatedT | None:
        """The browser that is closed for a new one: of guests, first those that must show a token, the oldest
        of the address that has most. None where all have shown one. `seated`: the oldest first.
        """
        guests = [one for one in seated if one.is_guest]
        among = [one for one in guests if one.must_show] or guests
        crowd = Counter(one.address for one in among)
        return max(among, key=lambda one: crowd[one.address], default=None)


def _is_loopback(address: str) -> bool:
    try:
        return ipaddress.ip_address(address).is_loopback
    except ValueError:
        return False
