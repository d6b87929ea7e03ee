"""Third-party programs against ours: `python -m tests.interop [--only NAME] [--strict]`. Prints a table.

The programs live in venvs under .venv-interop, made here by name from the package index, and run as
processes of their own; they never import our code, nor we theirs. They get a fake device on loopback or a
pseudo terminal, a recording, or a trajectory, and the truth as JSON; they judge by their own reading.

Each process has a timeout and is ended by its id, each wire is closed by its context. Where a package cannot
be installed, its checks are skipped with the reason in the table; --strict makes that a failure. Exits with 1
where a check failed.
"""

import argparse
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from service.compile.cache import ensure_cache_dir
from tests.interop.programs import ROOT, InteropError, UnavailableError, Venv


@dataclass(frozen=True, slots=True)
class Check:
    """One program and its check. `run` returns the result as text, or raises InteropError."""

    program: str
    against: str
    venv: Any  # Venv, or a Debian
    run: Callable[[Any, Path], str]


def _checks() -> list[Check]:
    from tests.interop import create, debian, hokuyo, install, ros2, session

    clients = Venv("clients", ("hokuyolx", "pycreate2", "pyroombaadapter", "setuptools"))
    readers = Venv("readers", ("mcap-ros2-support",))
    viewer = Venv("rerun", ("rerun-sdk",))
    scorer = Venv("evo", ("evo",))
    node = Venv("ros2-sdk", ("zenoh-ros2-sdk==0.1.8",))
    names = Venv("ros2-names", ("pamoja-ros2==0.2.0",))
    fresh = debian.Debian("debian")
    installers = Venv("installers", ("pip>=23.3", "pipx>=1.5", "uv"))
    return [
        Check("hokuyolx", "fake UTM-30LX-EW, TCP", clients, hokuyo.run_hokuyolx),
        Check("pycreate2", "fake Create 2, terminal", clients, create.run_pycreate2),
        Check("pyroombaadapter", "fake Create 2, terminal", clients, create.run_pyroombaadapter),
        Check("mcap-ros2-support", "a recorded session", readers, session.run_mcap_ros2),
        Check("rerun-sdk", "a recorded session", viewer, session.run_rerun),
        Check("evo", "corridor score", scorer, session.run_evo),
        Check("zenoh-ros2-sdk", "corridor run, ros2 on", node, ros2.run_sdk),
        Check("pamoja-ros2", "keys of ros2", names, ros2.run_pamoja),
        Check("pip", "wheels of dependencies", installers, install.run_wheels),
        Check("uv", "uv tool install", installers, install.run_uv),
        Check("pipx", "pipx install", installers, install.run_pipx),
        Check("uv", "the lowest versions", installers, install.run_lowest),
        Check("README", "first commands, Debian", fresh, debian.run_readme),
        Check("deb", "installed and purged", fresh, debian.run_deb),
        Check("Containerfile", "its steps, Debian", fresh, debian.run_containerfile),
    ]


def main() -> int:
    ensure_cache_dir()
    checks = _checks()
    parser = argparse.ArgumentParser(prog="python -m tests.interop", description=__doc__)
    parser.add_argument(
        "--only", action="append", choices=sorted({check.program for check in checks}), default=[]
    )
    parser.add_argument("--strict", action="store_true", help="a program that cannot be had is a failure")
    options = parser.parse_args()
    failed = skipped = 0
    with TemporaryDirectory(prefix="corridor-interop-") as folder:
        for check in checks:
            if options.only and check.program not in options.only:
                continue
            began_s, version = time.monotonic(), "-"
            try:
                check.venv.ensure()
                version = check.venv.version(check.program)
                words = f"ok: {check.run(check.venv, Path(folder))}"
            except UnavailableError as reason:
                skipped += 1
                words = f"skipped: {reason}"
            except InteropError as reason:
                failed += 1
                words = f"FAILED: {reason}"
            seconds = time.monotonic() - began_s
            print(f"{check.program:18} {version:8} {check.against:24} {seconds:5.1f} s  {words}", flush=True)
    print(f"{failed} failed, {skipped} skipped; the programs are in {ROOT}")
    return int(failed > 0 or (options.strict and skipped > 0))


if __name__ == "__main__":
    sys.exit(main())
