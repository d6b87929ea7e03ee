"""The mapper's process, begun before the config is checked: importing and loading take as long as in ingest.

start of the command --> process begins, imports, loads the kernels of the profile it is given -----> maps
                     --> ingest imports, checks the config, opens Zenoh, the recording, the devices
"""

import fcntl
import json
import os
import shutil
import socket
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Self

from service.interruption import before_ending
from service.located_yaml import MAX_FILE_BYTES, load

MODULE = "service.runtime.mapper_process"
CONFIG_ON_STDIN = "--config-on-stdin"  # the section "mapping" of the config, as JSON in one line
END_S = 2.0
FOLDER, SOCKET = "corridor-mapper-", "mapper.sock"


class MapperSocket:
    """A folder of its own with the socket at which the mapper and its stand-bys arrive.

    The folder is locked for as long as this process lives. The next one removes what a killed one left.
    """

    def __init__(self) -> None:
        remove_left_behind()
        self._folder = tempfile.TemporaryDirectory(prefix=FOLDER, ignore_cleanup_errors=True)
        self._lock: int | None = _locked(self.folder)
        self.server = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self.server.bind(str(self.folder / SOCKET))
        self.server.listen(4)
        self.server.setblocking(False)

    @property
    def folder(self) -> Path:
        return Path(self._folder.name)

    def close(self) -> None:
        self.server.close()
        self._folder.cleanup()
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None


def remove_left_behind() -> None:
    """Remove the folders of services that were killed. One without a socket is just being made."""
    for path in Path(tempfile.gettempdir()).glob(f"{FOLDER}*/{SOCKET}"):
        with suppress(OSError):  # another user's, that of a service that lives, or removed by now
            lock = _locked(path.parent)
            shutil.rmtree(path.parent, ignore_errors=True)
            os.close(lock)


def _locked(folder: Path) -> int:
    """A descriptor that locks a folder until it is closed, or its process ends. Raises BlockingIOError where
    another holds the lock.
    """
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(descriptor)
        raise
    return descriptor


class EarlyMapper:
    """`tell` it the section whose kernels to load; a MapperLink takes it over. On exit the process ends."""

    def __init__(self) -> None:
        self.mapper_socket = MapperSocket()
        before_ending(self.mapper_socket.close)
        self.process = subprocess.Popen(
            [sys.executable, "-m", MODULE, str(self.mapper_socket.folder), CONFIG_ON_STDIN],
            stdin=subprocess.PIPE,
            env=mapper_environment(),
            start_new_session=True,
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """End the process, if it has not ended."""
        assert self.process.stdin is not None
        with suppress(BrokenPipeError):
            self.process.stdin.close()
        self.process.kill()
        with suppress(subprocess.TimeoutExpired):
            self.process.wait(END_S)
        self.mapper_socket.close()

    def tell(self, mapping: Mapping[str, Any]) -> None:
        """The section "mapping" of the config, unchecked; which kernels to load follows from it."""
        assert self.process.stdin is not None
        with suppress(BrokenPipeError):  # it has failed, which the link will report
            self.process.stdin.write(json.dumps(dict(mapping)).encode() + b"\n")
            self.process.stdin.flush()


def mapping_section(path: Path) -> dict[str, Any]:
    """The section as it is in the file, unchecked; empty where there is none or the file cannot be read."""
    try:
        if not path.is_file() or path.stat().st_size > MAX_FILE_BYTES:
            return {}
        root = load(path.read_text(encoding="utf-8")).value
    except (OSError, ValueError):
        return {}  # the check of the config reports it
    section = root.get("mapping") if isinstance(root, dict) else None
    return section if isinstance(section, dict) else {}


def mapper_environment() -> dict[str, str]:
    return {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
