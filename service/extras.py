"""Packages that only some functions need, and the command that installs them beside the running program."""

import re
import shlex
import sys
from importlib import import_module
from importlib.metadata import requires
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from service.errors import CorridorError


def optional(module: str, extra: str, what: str) -> Any:
    """A module of an extra, which `what` needs. Raises CorridorError where it is not installed."""
    try:
        return import_module(module)
    except ImportError as error:
        raise CorridorError(
            f"{what} needs {module.partition('.')[0]}, which is not installed: {install_command(extra)}"
        ) from error


def install_command(extra: str) -> str:
    """The shell command that adds the packages of this extra of pyproject.toml to the program that runs now.

    It names packages, not `corridor[extra]`: that name on package indexes is not this project's.
    """
    packages = shlex.join(
        requirement.partition(";")[0].strip()
        for requirement in requires("corridor") or []
        if re.search(rf"extra == ['\"]{extra}['\"]", requirement)
    )
    if (Path(sys.prefix) / "pipx_metadata.json").exists():
        return f"pipx inject corridor {packages}"
    python = shlex.quote(sys.executable)
    if find_spec("pip") is None:  # as in the venvs of `uv tool install`
        return f"uv pip install --python {python} {packages}"
    return f"{python} -m pip install {packages}"
