"""`corridor map log`: the versions of a stored map, and who made them."""

import time
from pathlib import Path
from typing import Any

from service.mapstore.edits import Version
from service.mapstore.files import versions_of


def map_log(folder: Path) -> dict[str, Any]:
    """The versions by rising number, for JSON. Raises InputError where no map can be read."""
    versions, current, problems = versions_of(folder)
    return {
        "map": str(folder),
        "current": current,
        "versions": [_reported(version, version.number == current) for version in versions],
        "problems": problems,
    }


def log_table(log: dict[str, Any]) -> list[list[str]]:
    """Rows of words, heads first."""
    rows = [["version", "when", "who", "what", "words"]]
    for version in log["versions"]:
        mark = "*" if version["is_current"] else ""
        rows.append([f"{version['version']}{mark}", *(version[k] for k in ("saved", "who", "what", "words"))])
    return rows


def utc(unix_ns: int) -> str:
    return time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(unix_ns / 1e9))


def _reported(version: Version, is_current: bool) -> dict[str, Any]:
    edit, about = version.edit, version.about
    return {
        "version": version.number,
        "is_current": is_current,
        "saved": utc(version.saved_ns),
        "who": edit.who if edit is not None else about.get("vehicle", "-"),
        "what": edit.what if edit is not None else "saved",
        "words": edit.words if edit is not None else f"from {about.get('merged_from', 'mapping')}",
        "made_in": edit.before if edit is not None else None,
        "restores": edit.restores if edit is not None else None,
    }
