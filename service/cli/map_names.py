"""Stored maps as they are named on a command line: FOLDER, or FOLDER@VERSION."""

from pathlib import Path


def map_and_version(text: str) -> tuple[Path, int | None]:
    """office@12 is version 12 of office; a folder whose name holds an @ is itself."""
    folder, _, version = text.rpartition("@")
    if folder and version.isdigit() and not Path(text).exists():
        return Path(folder), int(version)
    return Path(text), None
