"""changes.json of a site's map: the places that changed from session to session, each with the cells of its
earlier state and the dates at which that was seen.
"""

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from service.errors import InputError
from service.mapper.map_changes import MapChanges
from service.offline.writing import complete_files
from service.readable import read_text

CHANGED_PLACES_FILE = "changes.json"
FORMAT = 1


@dataclass(frozen=True, slots=True)
class ChangedPlace:
    """A place where an object is "gone" or "new".

    x_m, y_m        middle, map frame
    seen_from_ns    begin of the first session that saw it as it was, Unix time
    seen_to_ns      end of the last one
    sessions        names of these two, or of the one
    changed_ns      begin of the first session that saw it changed
    session         its name
    cells           [column, row] of each changed cell; the lower left corner of [0, 0] is the map's origin
    """

    change: Literal["gone", "new"]
    x_m: float
    y_m: float
    area_m2: float
    seen_from_ns: int
    seen_to_ns: int
    sessions: list[str]
    changed_ns: int
    session: str
    cells: list[list[int]]


@dataclass(frozen=True, slots=True)
class ChangedPlaces:
    """version    of the map, by whose build they were found
    compared   of each session the `places` that it and earlier ones saw, and in how many of them something is
               `gone` or `new`
    """

    version: int
    cell_m: float
    places: list[ChangedPlace]
    compared: dict[str, dict[str, int]]

    def as_map_changes(self) -> MapChanges:
        """The newest change of each cell, for the page."""
        newest = {
            tuple(cell): place
            for place in sorted(self.places, key=lambda place: place.changed_ns)
            for cell in place.cells
        }
        cells = np.array(list(newest), np.float64).reshape(-1, 2)
        changed_ns = np.array([place.changed_ns for place in newest.values()], np.int64)
        return MapChanges(
            self.cell_m,
            (cells + 0.5) * self.cell_m,
            np.array([place.change == "new" for place in newest.values()], np.bool_),
            changed_ns,
            changed_ns,
            np.zeros(len(newest), np.int64),
        )


def write_changed_places(folder: Path, changed: ChangedPlaces) -> None:
    """Raises StorageError."""
    with complete_files(folder / CHANGED_PLACES_FILE) as path:
        path.write_text(json.dumps({"format": FORMAT, **asdict(changed)}) + "\n", encoding="utf-8")


def read_changed_places(folder: Path, version: int) -> ChangedPlaces | None:
    """Changed places of the file beside a map; None where there is none, or only of a later version than that
    which is read. Raises InputError.
    """
    path = folder / CHANGED_PLACES_FILE
    if not path.is_file():
        return None
    try:
        content = json.loads(read_text(path))
        if content.pop("format") != FORMAT:
            raise ValueError(f"this version of corridor reads format {FORMAT}")
        places = [ChangedPlace(**place) for place in content.pop("places")]
        changed = ChangedPlaces(places=places, **content)
        changed.as_map_changes()
        is_later = changed.version > version
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(
            f"{path}: no list of changed places: {error!r}; delete it to see the rest"
        ) from error
    return None if is_later else changed
