"""kept/NAME.npz: what a member of a site saw by itself, and its path when it was added. The next build reads
them instead of rendering the scans and parsing the path again.
"""

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from service.errors import InputError
from service.geometry.poses import Floats
from service.geometry.se2 import wrap_angle
from service.mapper.components import RenderedMap
from service.mapper.maps.occupancy import NO_CELLS
from service.mapstore.arrays import read_arrays, write_arrays
from service.offline.score.trajectory import Trajectory
from service.offline.writing import complete_files

log = logging.getLogger(__name__)

KEPT = "kept"  # below the map of the site
SAME_M, SAME_RAD = 0.01, 0.001  # a fifth of a cell of 5 cm, and the same 10 m away


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """Map of a member by itself, rendered with its key frames at (N, 3) in the map of the site."""

    rendered: RenderedMap
    keyframes: Floats

    def is_of(self, keyframes: Floats) -> bool:
        """Whether the key frames (N, 3) still lie within SAME_M and SAME_RAD of where they were."""
        if keyframes.shape != self.keyframes.shape:
            return False
        moved = keyframes - self.keyframes
        is_near = np.hypot(moved[:, 0], moved[:, 1]).max(initial=0.0) <= SAME_M
        return bool(is_near and np.abs(wrap_angle(moved[:, 2])).max(initial=0.0) <= SAME_RAD)


def write_kept(out: Path, name: str, seen: Seen, path: Trajectory) -> None:
    """path: any that `bent` takes to where the key frames are now. Raises StorageError."""
    rendered = seen.rendered
    arrays: dict[str, npt.NDArray[Any]] = {
        "tile_row": rendered.tile_row,
        "tile_column": rendered.tile_column,
        "evidence": rendered.evidence,
        "keyframes": seen.keyframes,
        "stamp_ns": path.stamp_ns,
        "pose": path.pose,
    }
    with complete_files(out / KEPT / f"{name}.npz") as new, new.open("wb") as file:
        write_arrays(file, arrays)


def read_kept(out: Path, name: str) -> tuple[Seen, Trajectory] | None:
    """None: it is damaged, with a warning, or a build before this file did not write it."""
    path = out / KEPT / f"{name}.npz"
    if not path.exists():
        return None
    try:
        arrays = read_arrays(path)
    except InputError as error:
        log.warning("%s: damaged; it is made again", error)
        return None
    rendered = RenderedMap(arrays["tile_row"], arrays["tile_column"], arrays["evidence"], NO_CELLS)
    return Seen(rendered, arrays["keyframes"]), Trajectory(arrays["stamp_ns"], arrays["pose"])
