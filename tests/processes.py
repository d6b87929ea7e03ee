"""Processes, read from /proc."""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple


class Process(NamedTuple):
    """As it is now."""

    pid: int
    parent: int
    group: int
    session: int
    niceness: int
    begun: int  # ticks since the boot
    cpu_s: float  # with that of its children that have ended


def alive() -> Iterator[Process]:
    """All that have not ended."""
    for name in filter(str.isdigit, os.listdir("/proc")):
        if (one := look_at(int(name))) is not None:
            yield one


def look_at(pid: int) -> Process | None:
    """None: it has ended."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return None
    if fields[0] == "Z":
        return None
    cpu_s = sum(map(int, fields[11:15])) / os.sysconf("SC_CLK_TCK")
    return Process(pid, *(int(fields[k]) for k in (1, 2, 3, 16, 19)), cpu_s)


def is_there(pid: int) -> bool:
    """Also where it has ended and has not been waited for."""
    return Path(f"/proc/{pid}").exists()


def command_of(pid: int) -> str:
    """Its arguments; "" where it has ended."""
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes().decode(errors="replace").replace("\0", " ")
    except OSError:
        return ""


def resident_mb(pid: int | None = None) -> float:
    """Memory of a process, or of this one. Raises OSError where it has ended."""
    pages = int(Path(f"/proc/{pid or 'self'}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6
