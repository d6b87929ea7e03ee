"""A stored map, made ready for a session to begin in."""

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from service.errors import ConfigError, InputError
from service.mapper.drawn_by_hand import walls_of
from service.mapper.maps.occupancy import rendered_of
from service.mapper.profiles import BeginIn, MappingConfig, begins_in_stored
from service.mapstore.files import StoredMap, load_map

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class MapVersion:
    """The version of a stored map that a session began in, as in its recording.

    digest   of the version's manifest: another version never has it, and a copy of the map does
    """

    folder: Path
    number: int
    digest: str

    def __str__(self) -> str:
        return f"{self.folder}@{self.number}"

    def as_metadata(self) -> dict[str, str]:
        return {"folder": str(self.folder), "version": str(self.number), "sha256": self.digest}


def recorded_version(metadata: Mapping[str, str]) -> MapVersion | None:
    """What as_metadata gave; None where there is nothing of it."""
    try:
        return MapVersion(Path(metadata["folder"]), int(metadata["version"]), metadata["sha256"])
    except (KeyError, ValueError):
        return None


def version_to_begin_in(folder: Path, config: MappingConfig) -> MapVersion:
    """The version that a session of this config begins in now, checked as by begin_in, which it raises as."""
    stored = stored_for(folder, config)
    _made_ready(folder, stored)
    return MapVersion(folder.resolve(), stored.number, stored.digest)


def begin_in(folder: Path, config: MappingConfig, version: int | None = None) -> BeginIn:
    """A version of the map in `folder` (None: the current one), for a session of this config.

    Raises as stored_for.
    """
    return _made_ready(folder, stored_for(folder, config, version))


def _made_ready(folder: Path, stored: StoredMap) -> BeginIn:
    assert stored.graph is not None
    try:
        walls = walls_of(stored.graph.by_hand, stored.graph.map)
        return BeginIn(stored.graph, rendered_of(stored.tiles, walls), stored.geo)
    except ValueError as error:
        raise InputError(f"{folder}: {error}") from error


def stored_for(folder: Path, config: MappingConfig, version: int | None = None) -> StoredMap:
    """A version of the map in `folder` (None: the current one), if a session of this config can begin in it.

    Raises InputError where there is no map, where it is a picture only, or where its cells are of another
    size; ConfigError where the profile cannot begin in a stored map.
    """
    if not begins_in_stored(config):
        raise ConfigError([f"the profile {config.profile} cannot begin in a stored map; use corridor"])
    stored = load_map(folder, version)
    for problem in stored.problems:
        log.warning("%s", problem)
    if stored.graph is None:
        raise InputError(
            f"{folder}: this map holds what was shown, not what it was made of; mapping cannot go on in it. "
            "Replay its recording with --out: that writes a map that can be gone on in"
        )
    sizes = {tile.cell_m for tile in stored.tiles if tile.level == 0}
    if sizes != {config.cell_m}:
        found = ", ".join(f"{size:g}" for size in sorted(sizes))
        raise InputError(
            f"{folder}: its cells are of {found} m, the config has mapping.cell_m {config.cell_m:g}"
        )
    return stored
