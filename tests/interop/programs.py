"""Venvs for programs of other people, and how they are run: always another process, always bounded."""

import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2] / ".venv-interop"
CLIENTS = Path(__file__).parent / "clients"
INSTALL_TIMEOUT_S = 600.0
CLIENT_TIMEOUT_S = 90.0
TAIL_CHARS = 1500


class UnavailableError(Exception):
    """A package cannot be had here."""


class InteropError(Exception):
    """A program did not see what it should, or did not end."""


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
        done = subprocess.run(
            command,
            capture_output=True,
            text=True,
            timeout=INSTALL_TIMEOUT_S,
            check=False,
            env=environment(),
        )
    except subprocess.TimeoutExpired as error:
        raise UnavailableError(f"pip did not end within {INSTALL_TIMEOUT_S:g} s") from error
    if done.returncode != 0:
        errors = [line for line in done.stderr.splitlines() if line.startswith("ERROR")]
        raise UnavailableError(errors[-1] if errors else f"exit code {done.returncode}: {done.stderr[-200:]}")


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
        told = (done.stdout + done.stderr)[-TAIL_CHARS:]
        raise InteropError(f"{Path(command[0]).name} ended with {done.returncode}:\n{told}")
    return done.stdout


def run_client(venv: Venv, script: str, facts: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Run clients/<script> there with the facts as a JSON file; its last line. Raises InteropError."""
    told = folder / f"{Path(script).stem}.json"
    told.write_text(json.dumps(facts))
    out = run([str(venv.bin / "python"), "-E", "-s", str(CLIENTS / script), str(told)])
    seen: dict[str, Any] = json.loads(out.splitlines()[-1])
    return seen


def environment(home: Path | None = None) -> dict[str, str]:
    """Of a program: ours without what would lead a program to our packages; some write settings into HOME."""
    environment = {
        key: value for key, value in os.environ.items() if not key.startswith(("PYTHON", "VIRTUAL_ENV"))
    }
    if home is not None:
        environment["HOME"] = str(home)
    return environment
