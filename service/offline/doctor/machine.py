"""What the doctor queries of the machine it runs on; each in one place, so that a test can replace it."""

import ctypes
import os
import pwd
import shutil
import socket
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

STA_UNSYNC = 0x0040  # adjtimex(2)
TIME_ERROR = 5


class KernelClock(NamedTuple):
    """State of the system clock by adjtimex(2)."""

    is_synchronised: bool
    max_error_s: float


class _Timex(ctypes.Structure):
    """struct timex up to `status`, and room for the rest: adjtimex(2)."""

    _fields_ = (
        ("modes", ctypes.c_uint),
        ("offset", ctypes.c_long),
        ("freq", ctypes.c_long),
        ("maxerror", ctypes.c_long),
        ("esterror", ctypes.c_long),
        ("status", ctypes.c_int),
        ("rest", ctypes.c_char * 256),
    )


def read_kernel_clock() -> KernelClock | None:
    """None where the kernel, or a sandbox, does not report it."""
    try:
        adjtimex = ctypes.CDLL(None, use_errno=True).adjtimex
    except (OSError, AttributeError):
        return None
    timex = _Timex()  # modes 0: only read
    state = adjtimex(ctypes.byref(timex))
    if state < 0:
        return None
    unsynchronised = state == TIME_ERROR or bool(timex.status & STA_UNSYNC)
    return KernelClock(not unsynchronised, timex.maxerror / 1e6)


def _user_name() -> str:
    try:
        return pwd.getpwuid(os.geteuid()).pw_name
    except KeyError:
        return f"uid {os.geteuid()}"


@dataclass(frozen=True)
class Machine:
    """`root` stands for / in every path read: /proc, /sys, /dev, /etc and the config's folders."""

    root: Path = Path("/")
    environment: Mapping[str, str] = field(default_factory=lambda: dict(os.environ))
    user: str = field(default_factory=_user_name)
    group_ids: frozenset[int] = field(default_factory=lambda: frozenset({os.getegid(), *os.getgroups()}))
    is_root: bool = field(default_factory=lambda: os.geteuid() == 0)
    may_read_and_write: Callable[[Path], bool] = lambda path: os.access(path, os.R_OK | os.W_OK)
    free_bytes: Callable[[Path], int] = lambda path: shutil.disk_usage(path).free
    kernel_clock: Callable[[], KernelClock | None] = read_kernel_clock
    unix_s: Callable[[], float] = time.time
    bind: Callable[[socket.socket, Any], None] = lambda door, address: door.bind(address)

    def path(self, name: str | Path) -> Path:
        """An absolute path under this machine's root; a relative one is returned as it is."""
        given = Path(name)
        return self.root / given.relative_to("/") if given.is_absolute() else given

    def text(self, name: str) -> str:
        """A small file's content without blanks around it, "" where it cannot be read."""
        try:
            return self.path(name).read_text(encoding="utf-8", errors="replace").strip()
        except OSError:
            return ""
