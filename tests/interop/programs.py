"""Venvs for third-party programs, each run in a process of its own with a timeout."""

import json
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

ROOT = Path(__file__).parents[2] / ".venv-interop"
CLIENTS = Path(__file__).parent / "clients"
INSTALL_TIMEOUT_S = 600.0
CLIENT_TIMEOUT_S, TALK_TIMEOUT_S = 90.0, 180.0
TAIL_CHARS = 1500


class UnavailableError(Exception):
    """A package cannot be installed here."""


class InteropError(Exception):
    """A program's result is wrong, or it did not end."""


@dataclass(frozen=True, slots=True)
class Venv:
    """A venv with these packages, newest that pip finds."""

    name: str
    packages: tuple[str, ...]

    @property
    def bin(self) -> Path:
        return ROOT / self.name / "bin"

    def ensure(self) -> None:
        """Make it where it is not there yet. Raises UnavailableError."""
        stamp = ROOT / self.name / "installed"
        wanted = "\n".join(self.packages) + "\n"
        if stamp.exists() and stamp.read_text() == wanted:
            return
        _install([sys.executable, "-m", "venv", "--clear", str(ROOT / self.name)])
        pip = [str(self.bin / "python"), "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
        _install([*pip, *self.packages])
        stamp.write_text(wanted)

    def version(self, package: str) -> str:
        program = "import sys, importlib.metadata as m; print(m.version(sys.argv[1]))"
        return run([str(self.bin / "python"), "-c", program, package]).strip()


def _install(command: list[str]) -> None:
    try:
        run(command, timeout_s=INSTALL_TIMEOUT_S)
    except InteropError as error:
        errors = [line for line in str(error).splitlines() if line.startswith("ERROR")]
        raise UnavailableError(errors[-1] if errors else str(error)[-200:]) from error


def run(command: list[str], home: Path | None = None, timeout_s: float = CLIENT_TIMEOUT_S) -> str:
    """Its stdout. Raises InteropError where it does not end well in time."""
    try:
        done = subprocess.run(
            command,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=timeout_s,
            check=False,
            env=environment(home),
        )
    except subprocess.TimeoutExpired as error:
        raise InteropError(f"{Path(command[0]).name} did not end within {timeout_s:g} s") from error
    if done.returncode != 0:
        output = (done.stdout + done.stderr)[-TAIL_CHARS:]
        raise InteropError(f"{Path(command[0]).name} ended with {done.returncode}:\n{output}")
    return done.stdout


def run_client(venv: Venv, script: str, facts: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Run clients/<script> there with the facts as a JSON file; its last line. Raises InteropError."""
    seen: dict[str, Any] = json.loads(run(_command(venv, script, facts, folder)).splitlines()[-1])
    return seen


@contextmanager
def started_client(
    venv: Venv, script: str, facts: dict[str, Any], folder: Path, stderr: int | None = None
) -> Iterator[tuple[subprocess.Popen[str], IO[str], IO[str]]]:
    """The same script with stdin and stdout, while it runs; killed at the end, or after TALK_TIMEOUT_S."""
    command = _command(venv, script, facts, folder)
    pipe = subprocess.PIPE
    process = subprocess.Popen(
        command, stdin=pipe, stdout=pipe, stderr=stderr, text=True, env=environment(folder)
    )
    assert process.stdin is not None
    assert process.stdout is not None
    guard = threading.Timer(TALK_TIMEOUT_S, process.kill)
    guard.start()
    try:
        yield process, process.stdin, process.stdout
    finally:
        guard.cancel()
        process.kill()
        process.communicate()


def _command(venv: Venv, script: str, facts: dict[str, Any], folder: Path) -> list[str]:
    facts_file = folder / f"{Path(script).stem}.json"
    facts_file.write_text(json.dumps(facts))
    return [str(venv.bin / "python"), "-E", "-s", str(CLIENTS / script), str(facts_file)]


def environment(home: Path | None = None) -> dict[str, str]:
    """Ours without variables that lead to our packages; some programs write settings into HOME."""
    environment = {
        key: value for key, value in os.environ.items() if not key.startswith(("PYTHON", "VIRTUAL_ENV"))
    }
    if home is not None:
        environment["HOME"] = str(home)
    return environment
