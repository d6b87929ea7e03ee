"""manifest.json of a version of a stored map: what it is, and SHA-256 of its files and of itself."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, Field, NonNegativeInt, StringConstraints, ValidationError

from drivers.counted import counted
from service.errors import InputError, words_of
from service.limits import MAX_MAP_BYTES, MAX_MEMBERS, check
from service.mapstore.edits import Edit
from service.readable import open_file, read_text
from service.version import VERSION
from service.writable import sync

FORMAT = 4
MANIFEST = "manifest.json"


class _File(BaseModel):
    bytes: NonNegativeInt
    sha256: str


class Manifest(BaseModel):
    """Checked: all is of its type, and no file lies in another folder."""

    saved_ns: Annotated[int, Field(ge=0, lt=2**63)]  # Unix time
    about: dict[str, str]
    edit: Edit | None = None  # that made the version
    files: dict[Annotated[str, StringConstraints(pattern=r"^\w[\w.]*$")], _File]
    digest: str  # SHA-256 of the manifest


def write_manifest(
    folder: Path, names: Sequence[str], saved_ns: int, about: Mapping[str, str], edit: Edit | None
) -> None:
    """Write it beside the files of `names`, and put all that is in the folder on the disk. Raises OSError."""
    manifest = {
        "format": FORMAT,
        "corridor": VERSION,
        "saved_ns": saved_ns,
        "about": dict(about),
        "edit": None if edit is None else asdict(edit),
        "files": {
            name: {"bytes": (folder / name).stat().st_size, "sha256": _sha256(folder / name)}
            for name in names
        },
    }
    text = json.dumps({**manifest, "sha256": digest_of(manifest)}, indent=1)
    (folder / MANIFEST).write_text(text + "\n", encoding="utf-8")
    for path in folder.iterdir():
        sync(path)


def read_manifest(version: Path) -> Manifest:
    """Raises InputError where it is not there or damaged, TooLargeError where the files it names are."""
    path = version / MANIFEST
    try:
        manifest = json.loads(read_text(path))
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: damaged: {words_of(error)}") from error
    if not isinstance(manifest, dict):
        raise InputError(f"{path}: damaged: no JSON object")
    own = manifest.pop("sha256", None)
    if own != (digest := digest_of(manifest)):
        raise InputError(f"{path}: damaged: its own checksum does not fit")
    if manifest.get("format") != FORMAT:
        raise InputError(
            f"{path}: format {manifest.get('format')} of corridor {manifest.get('corridor')}; "
            f"this is corridor {VERSION}, which reads format {FORMAT}"
        )
    try:
        checked = Manifest.model_validate({**manifest, "digest": digest})
    except ValidationError as error:
        first = error.errors()[0]
        raise InputError(f"{path}: {'.'.join(map(str, first['loc']))}: {first['msg']}") from error
    check(len(checked.files), MAX_MEMBERS, str(path), "files")
    check(sum(entry.bytes for entry in checked.files.values()), MAX_MAP_BYTES, f"{path}: the map")
    return checked


def check_files(version: Path, manifest: Manifest) -> None:
    """Raises InputError where one is not there, or not what was saved."""
    for name, expected in manifest.files.items():
        path = version / name
        try:
            size = path.stat().st_size
            is_whole = size == expected.bytes and _sha256(path) == expected.sha256
        except OSError as error:
            raise InputError(f"{path}: {error.strerror}") from error
        if not is_whole:
            raise InputError(f"{path}: {counted(size, 'byte')}, not the {expected.bytes} saved: damaged")


def _sha256(path: Path) -> str:
    with open_file(path) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def digest_of(manifest: Mapping[str, Any]) -> str:
    """SHA-256 of all of it but its own "sha256"."""
    return hashlib.sha256(json.dumps(manifest, sort_keys=True).encode()).hexdigest()
