"""The links of a stored map, which point to what is in use in its folder: each switched in one step.

A copy that follows links (cp -rL, most sticks and archives) has files in their place. Those that are the same
as in one of the versions are replaced by links again; other files stay.
"""

import filecmp
import os
import shutil
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from service.errors import StorageError
from service.writable import sync

CURRENT = "current"
UNFINISHED = ".unfinished-"  # begins the names that no one reads


def point_for_others(folder: Path, names: Sequence[str], versions: Sequence[Path]) -> None:
    """Have what other programs read lead to the current version. Raises StorageError, OSError.

    versions   folders of the versions that are there
    """
    for name in names:
        path, target = folder / name, f"{CURRENT}/{name}"
        if path.is_symlink() and os.readlink(path) == target:
            continue
        if path.exists() and not path.is_symlink() and not _is_copy(path, [v / name for v in versions]):
            raise StorageError(
                f"{path} is a file of somebody else; choose another map.directory or move it away"
            )
        point(path, target)


def point_to_current(folder: Path, versions: Sequence[Path]) -> None:
    """Where `current` is the copy of a version, make it the link to it. Raises StorageError, OSError."""
    current = folder / CURRENT
    if current.is_symlink() or not current.exists():
        return
    manifests = [version / "manifest.json" for version in versions]
    for manifest in manifests:
        if _is_copy(current / "manifest.json", [manifest]):
            aside = folder / f"{UNFINISHED}copy"
            current.rename(aside)
            point(current, manifest.parent.name)
            shutil.rmtree(aside, ignore_errors=True)
            return
    raise StorageError(f"{current} is neither a link nor the copy of a version; move it away")


def point(link: Path, target: str) -> None:
    """Make `link` a link to `target` in one step that is on disk when this returns. Raises OSError."""
    new = link.with_name(f"{UNFINISHED}{link.name}")
    new.unlink(missing_ok=True)
    new.symlink_to(target)
    new.replace(link)
    sync(link.parent)


def _is_copy(path: Path, originals: Sequence[Path]) -> bool:
    for original in originals:
        with suppress(OSError):
            if filecmp.cmp(path, original, shallow=False):
                return True
    return False
