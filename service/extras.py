"""Packages that only some functions need, and the command that installs them beside the running program."""

import re
import shlex
import sys
from importlib.metadata import requires
from importlib.util import find_spec
from pathlib import Path


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
