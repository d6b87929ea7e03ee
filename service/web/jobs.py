"""Work on stored maps and sessions in processes of their own, at low priority."""

import json
import select
import shutil
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

from service.errors import words_of

WORK_TIMEOUT_S = 300.0  # of an export or an edit
TURN_TIMEOUT_S = 20.0  # until the request before is answered
STOPPING = "the service is stopping"


class ResourceError(Exception):
    """Why something is not done, as text for the client."""


class CommandProcess:
    """Runs `corridor ...`, one after the other. `close`, from any thread, ends what runs."""

    def __init__(self) -> None:
        self._lock = threading.Lock()  # of both below
        self._process: subprocess.Popen[str] | None = None
        self._is_closed = False

    def run(self, *arguments: str) -> str:
        """Stdout. Raises ResourceError."""
        command = _gentle("-m", "service", *arguments)
        with self._lock:
            if self._is_closed:
                raise ResourceError(STOPPING)
            process = self._process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
            )
        with process:
            try:
                out, err = process.communicate(timeout=WORK_TIMEOUT_S)
            except subprocess.TimeoutExpired as error:
                process.kill()
                raise ResourceError(f"it took longer than {WORK_TIMEOUT_S:.0f} s and was ended") from error
        with self._lock:
            self._process = None
            if self._is_closed:
                raise ResourceError(STOPPING)
        if process.returncode != 0:
            error_lines = err.strip().splitlines()
            raise ResourceError(
                error_lines[-1]
                if error_lines
                else f"{arguments[0]} ended with exit code {process.returncode}"
            )
        return out

    def close(self) -> None:
        """At once; nothing is begun any more."""
        with self._lock:
            self._is_closed = True
            if self._process is not None:
                self._process.kill()


class SessionMapProcess:
    """Queries service.offline.maps.session_commands, which is started by the first request. Thread-safe."""

    def __init__(self) -> None:
        self._turn = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None

    def ask(self, verb: str, folder: Path, request: dict[str, Any]) -> dict[str, Any]:
        """The answer. Raises ResourceError."""
        line = json.dumps({"verb": verb, "map": str(folder), "request": request}).encode() + b"\n"
        if not self._turn.acquire(timeout=TURN_TIMEOUT_S):
            raise ResourceError("the request before is still being carried out; ask again when it is done")
        try:
            answer = self._talk(line)
        finally:
            self._turn.release()
        if not answer.pop("ok"):
            raise ResourceError(answer["error"])
        return answer

    def close(self) -> None:
        """End the process at once."""
        process, self._process = self._process, None
        if process is None:
            return
        process.kill()
        process.wait()
        for pipe in (process.stdin, process.stdout):
            assert pipe is not None
            pipe.close()

    def _talk(self, line: bytes) -> dict[str, Any]:
        if self._process is None or self._process.poll() is not None:
            self.close()  # it has nothing to do for long, and has ended
            command = _gentle("-m", "service.offline.maps.session_commands")
            self._process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, bufsize=0
            )
        requests, answers = self._process.stdin, self._process.stdout
        assert requests is not None
        assert answers is not None
        try:
            requests.write(line)
            if not select.select([answers], [], [], WORK_TIMEOUT_S)[0]:
                self.close()
                raise ResourceError(f"it took longer than {WORK_TIMEOUT_S:.0f} s and was ended")
            facts = _line(answers)
        except (OSError, ValueError) as error:  # ended during the request
            raise ResourceError(f"the process that works on maps was ended: {words_of(error)}") from error
        if not facts:
            raise ResourceError("the process that works on maps has ended; the log of the service says why")
        answer: dict[str, Any] = json.loads(facts)
        return answer


def _line(answers: Any) -> bytes:
    """The rest of it, which comes at once."""
    facts = b""
    while not facts.endswith(b"\n") and (part := answers.read(65_536)):
        facts += part
    return facts


def _gentle(*arguments: str) -> list[str]:
    """Python with these, at low priority where that can be had."""
    command = [sys.executable, *arguments]
    nice = shutil.which("nice")
    return [nice, "-n", "10", *command] if nice else command
