"""`corridor map remap`: an area of a stored map driven again; nothing else of the map changes."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from drivers.counted import counted
from service.errors import UsageError
from service.geometry.polygons import Cells, area_m2, cells_inside
from service.geometry.poses import Floats
from service.mapper.edit_requests import EditError
from service.mapper.graph.edit.remapping import scans_of, with_area_driven_again
from service.mapper.maps.occupancy import OccupancyConfig, OccupancyTiles
from service.mapper.saved_graph import SavedGraph
from service.mapstore.drawn_tiles import with_cells
from service.mapstore.files import StoredMap
from service.offline.maps.edit import Change, Changed, edit_map, points_of
from service.offline.replay.replay import replay
from service.offline.replay.run import Progress
from service.offline.replay.setup import ReplayOptions
from service.outputs import UNKNOWN, TileUpdate


def map_remap(
    folder: Path,
    recordings: Sequence[Path],
    corners: Sequence[float],
    who: str,
    now_ns: int,
    progress: Progress = lambda share, phase: None,
) -> dict[str, Any]:
    """Localise a recording in a map, and put what it saw within an area in the place of what the map has
    there: a new version, and a summary for JSON.

    corners   X Y X Y ... of the area, m in the map;  now_ns  Unix time

    Raises UsageError where these are no area; InputError and StorageError as replay and edit_map do.
    """
    outline = points_of(corners, least=3)
    if area_m2(outline) < 1e-4:
        raise UsageError("map remap --area: the corners X Y X Y X Y... enclose no area")
    done = replay(recordings, ReplayOptions(map=folder, localize=True), progress)
    return edit_map(folder, "remap", driven_again(done.session, outline), who, now_ns)


def driven_again(session: SavedGraph | None, outline: Floats) -> Change:
    """An area (C, 2) m is what a session saw of it that was localised in the map."""

    def change(stored: StoredMap) -> Changed:
        if stored.graph is None or session is None:
            raise EditError("there is no graph to put the drive into")
        known = len(stored.graph)
        if not np.array_equal(session.stamp_ns[:known], stored.graph.stamp_ns):
            raise EditError("the map has changed since the drive was localised in it; run the command again")
        shown = OccupancyTiles(OccupancyConfig(), stored.cell_m)
        shown.replace_by(shown.renderer.render(scans_of(session, known)), ())
        driven = shown.changed_tiles()
        if not len(seen := _seen(driven, outline, stored.cell_m)):
            raise EditError("the drive saw nothing of the area")
        tiles, cells = with_cells(stored.tiles, seen, stored.cell_m, driven)
        done = with_area_driven_again(stored.graph, session, outline, seen, stored.cell_m)
        facts = {
            "cells_changed": cells,
            "keyframes_new": done.keyframes,
            "points_gone": done.points_gone,
            "points_new": done.points_new,
        }
        x_m, y_m = outline.mean(axis=0).tolist()
        words = (
            f"drove {area_m2(outline):.1f} m2 about ({x_m:.2f}, {y_m:.2f}) m again: "
            f"{counted(cells, 'cell')}, "
            f"{counted(done.points_gone, 'point')} gone and {done.points_new} new in "
            f"{counted(done.keyframes, 'key frame')}"
        )
        return Changed(replace(stored, tiles=tiles, graph=done.graph), words, facts)

    return change


def _seen(driven: Sequence[TileUpdate], outline: Floats, cell_m: float) -> Cells:
    """The cells within the area that the drive has seen."""
    inside = cells_inside(outline, cell_m)
    seen = [np.empty((0, 2), np.int64)]
    for tile in driven:
        edge = len(tile.cells)
        own = inside[(inside // edge == (tile.iy, tile.ix)).all(axis=1)]
        seen.append(own[tile.cells[tuple((own % edge).T)] != UNKNOWN])
    return np.concatenate(seen)
