"""Who changed a stored map by hand, when and how: kept with the version that the change made."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from service.errors import InputError


@dataclass(frozen=True, slots=True)
class Edit:
    """One change by hand."""

    who: str
    what: str  # "erase", "wall", "cut" ... as the command calls it
    words: str  # what it did, with figures, for a person
    before: int  # number of the version that it was made in
    restores: int | None = None  # of an undo: number of the version that this one is again


@dataclass(frozen=True, slots=True)
class Version:
    """What is known of a version without reading its map."""

    number: int
    saved_ns: int  # Unix time
    about: Mapping[str, str]
    edit: Edit | None  # None: a session, a replay or a merge saved it


def kept_for_ever(versions: Iterable[Version]) -> set[int]:
    """Numbers of the versions that an edit made, was made in, or went back to."""
    edits = [(version.number, version.edit) for version in versions if version.edit is not None]
    before = {edit.before for _, edit in edits}
    restored = {edit.restores for _, edit in edits if edit.restores is not None}
    return {number for number, _ in edits} | before | restored


def undone_by(versions: Iterable[Version], current: int) -> tuple[Version, int]:
    """The version whose edit the next undo takes back, and the number of the version it goes back to.

    One undo after another goes back edit by edit. Raises InputError where no edit is left to take back.
    """
    by_number = {version.number: version for version in versions}
    number = current
    seen = set()
    while number not in seen:
        seen.add(number)
        version = by_number.get(number)
        if version is None:
            raise InputError(f"version {number}, that an edit went back to, is not there any more")
        if version.edit is None:
            break
        if version.edit.restores is None:
            return version, version.edit.before
        number = version.edit.restores
    raise InputError(
        f"version {current} holds no edit that could be taken back; "
        "map log lists the versions, and --undo --to N goes back to any of them"
    )
