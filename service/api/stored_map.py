"""Stored maps: to look at, and to find a scan in."""

from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy.typing as npt

from drivers.frames import LaserScan
from service.api.mapper import Mapper, locate
from service.api.poses import Pose
from service.api.recordings import AnyPath
from service.geometry.geo_reference import GeoReference
from service.mapstore.files import StoredMap, load_map
from service.mapstore.tiles import grid_of_tiles
from service.outputs import Grid


class Map:
    """One version of a stored map, by `load`.

    folder    where it is stored
    version   its number in that folder
    about     who made it: vehicle, profile
    geo       where it lies on the earth; None: that is not known
    """

    def __init__(self, folder: Path, stored: StoredMap) -> None:
        self._stored = stored
        self.folder = folder
        self.version = stored.number
        self.about: Mapping[str, str] = stored.about
        self.geo: GeoReference | None = stored.geo

    @classmethod
    def load(cls, folder: AnyPath, version: int | None = None) -> "Map":
        """The version of that number; None: the newest that is complete. Raises InputError."""
        return cls(Path(folder), load_map(Path(folder), version))

    @cached_property
    def grid(self) -> Grid:
        """Its cells as one picture. Raises StorageError beyond 410 m square at 5 cm."""
        return grid_of_tiles(self._stored.tiles)

    def localize(
        self,
        scan: LaserScan,
        config: AnyPath | Mapping[str, Any] | None = None,
        mountings: Mapping[str, npt.ArrayLike] | None = None,
    ) -> Pose | None:
        """Where the base was when this scan was taken by a vehicle at rest; None: the scan fits nowhere,
        or at several places about equally well.

        Each call searches the complete map. To follow a vehicle through it, process its frames in a
        Mapper(map=folder, localize=True).

        config, mountings   as of Mapper; without either the scan's laser is at the base's origin

        Raises as Mapper does.
        """
        if config is None:
            mountings = {scan.sensor: (0.0, 0.0, 0.0)} if mountings is None else mountings
            config = {"mapping": {"cell_m": self._stored.cell_m}}
        mapper = Mapper(config, mountings, map=self.folder, version=self.version, localize=True)
        return locate(scan, mapper)
