"""Processes of this machine, and files and ports they hold, from /proc; of other users the name alone."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from service.offline.doctor.machine import Machine

_LISTENING = {"tcp": "0A", "udp": "07"}  # state of a bound socket in /proc/net/<protocol>
_LIVE_COMMANDS = ("run", "demo")


@dataclass(frozen=True, slots=True)
class Process:
    number: int
    name: str
    arguments: tuple[str, ...]

    def __str__(self) -> str:
        return f"{self.name} (process {self.number})"

    @property
    def is_service(self) -> bool:
        """Whether this is `corridor run` or `corridor demo`, by whatever path it was started, as a module of
        Python too (`python -m service run`), and with options ahead of the command.
        """
        for at, argument in enumerate(self.arguments):
            is_module = argument == "service" and at > 0 and self.arguments[at - 1] == "-m"
            words = (word for word in self.arguments[at + 1 :] if not word.startswith("-"))
            is_program = is_module or Path(argument).name == "corridor"
            if is_program and next(words, "") in _LIVE_COMMANDS:
                return True
        return False


def processes(machine: Machine) -> Iterator[Process]:
    for folder in sorted(machine.path("/proc").glob("[0-9]*")):
        if (process := _read(folder)) is not None:
            yield process


def named(machine: Machine, *names: str) -> list[Process]:
    """Processes of one of these names. The kernel keeps the first 15 characters of a name."""
    short = {name[:15] for name in names}
    return [process for process in processes(machine) if process.name in short]


def holders(machine: Machine, path: Path) -> list[Process]:
    """Processes that have this file or device open, as far as permitted; `path` without links in it."""
    return _with_descriptor(machine, {str(path), str(machine.path(path))})


def listeners(machine: Machine, port: int, protocol: str) -> list[Process]:
    """Processes that listen at a port of tcp or udp, as far as permitted."""
    sockets = set()
    for table in (protocol, f"{protocol}6"):
        for line in machine.text(f"/proc/net/{table}").splitlines()[1:]:
            fields = line.split()
            if int(fields[1].rpartition(":")[2], 16) == port and fields[3] == _LISTENING[protocol]:
                sockets.add(f"socket:[{fields[9]}]")
    return _with_descriptor(machine, sockets)


def _with_descriptor(machine: Machine, targets: set[str]) -> list[Process]:
    found = []
    for folder in sorted(machine.path("/proc").glob("[0-9]*")) if targets else ():
        try:
            is_open = any(str(descriptor.readlink()) in targets for descriptor in (folder / "fd").iterdir())
        except OSError:
            continue  # gone meanwhile, or another user's
        if is_open and (process := _read(folder)) is not None:
            found.append(process)
    return found


def _read(folder: Path) -> Process | None:
    try:
        name = (folder / "comm").read_text(errors="replace").strip()
        arguments = (folder / "cmdline").read_bytes().decode("utf-8", "replace").split("\0")
    except OSError:
        return None
    return Process(int(folder.name), name, tuple(argument for argument in arguments if argument))
