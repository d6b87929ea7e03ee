"""Folders without rights, given to commands. Root may read all, so the system is asked to refuse."""

import os
from pathlib import Path

import pytest

from service.cli import main
from service.errors import InputError


@pytest.mark.parametrize(
    "command",
    [
        ["replay", "{}"],
        ["map", "info", "{}"],
        ["view", "{}"],
        ["export", "{}", "--format", "png", "--out", "x.png"],
    ],
)
def test_a_folder_without_rights_is_reported_by_every_command(
    command: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    def refuse(path: object) -> None:
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(os, "listdir", refuse)
    assert main([word.format(tmp_path) for word in command]) == InputError.exit_code
    printed = capsys.readouterr().err
    assert "Permission denied" in printed
    assert "Errno" not in printed
