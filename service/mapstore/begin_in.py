"""A stored map, made ready for a session to begin in."""

import logging
from pathlib import Path

from service.errors import InputError
from service.mapper.maps.occupancy import rendered_of
from service.mapper.profiles import BeginIn
from service.mapstore.files import load_map

log = logging.getLogger(__name__)


def begin_in(folder: Path, cell_m: float) -> BeginIn:
    """The current version of the map in `folder`, for a session whose shown map has cells of cell_m.

    Raises InputError where there is no map, where it is a picture only, or where its cells are of another
    size.
    """
    stored = load_map(folder)
    for problem in stored.problems:
        log.warning("%s", problem)
    if stored.graph is None:
        raise InputError(
            f"{folder}: this map holds what was shown, not what it was made of; mapping cannot go on in it. "
            "Replay its recording with --out: that writes a map that can be gone on in"
        )
    sizes = {tile.cell_m for tile in stored.tiles if tile.level == 0}
    if sizes != {cell_m}:
        found = ", ".join(f"{size:g}" for size in sorted(sizes))
        raise InputError(f"{folder}: its cells are of {found} m, the config has mapping.cell_m {cell_m:g}")
    try:
        return BeginIn(stored.graph, rendered_of(stored.tiles), stored.geo)
    except ValueError as error:
        raise InputError(f"{folder}: {error}") from error
