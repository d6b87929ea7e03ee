"""The command that installs an extra, in each kind of venv that users have."""

import subprocess
import sys
from importlib.metadata import requires

import pytest

import service.extras
from service.extras import install_command


def test_the_command_names_what_pyproject_declares():
    declared = {one.partition(";")[0].strip() for one in requires("corridor") or [] if "export" in one}
    command = install_command("export")
    shown = subprocess.run(
        ["sh", "-c", f"printf '%s\\n' {command}"], capture_output=True, text=True, check=True
    )
    python, *words = shown.stdout.splitlines()
    assert (python, words[:3]) == (sys.executable, ["-m", "pip", "install"])
    assert set(words[3:]) == declared != set()


def test_a_venv_of_pipx_is_extended_by_pipx(tmp_path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "pipx_metadata.json").write_text("{}")
    monkeypatch.setattr(sys, "prefix", str(tmp_path))
    assert install_command("plot") == "pipx inject corridor 'matplotlib>=3.8'"


def test_a_venv_without_pip_is_extended_by_uv(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(service.extras, "find_spec", lambda name: None)
    monkeypatch.setattr(sys, "executable", "/home/ada/my tools/bin/python")
    command = "uv pip install --python '/home/ada/my tools/bin/python' 'matplotlib>=3.8'"
    assert install_command("plot") == command
