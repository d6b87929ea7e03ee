"""Manual edits in the order in which they are rendered among the scans."""

from collections.abc import Iterable, Iterator

from service.geometry.poses import Floats
from service.mapper.by_hand import DRAWN_WALL, ERASED, ERASED_TO_FREE, ByHand, Drawing
from service.mapper.components import AreaToErase, ScanToRender, ToRender, WallToRender


def walls_of(by_hand: ByHand, map_poses: Floats) -> list[WallToRender]:
    """Walls with the key frames at map_poses, (N, 3), each with the areas erased after it."""
    drawings = by_hand.drawings(map_poses)
    return [
        WallToRender(
            drawing.corners_map, [later.corners_map for later in drawings[k:] if later.kind != DRAWN_WALL]
        )
        for k, drawing in enumerate(drawings)
        if drawing.kind == DRAWN_WALL
    ]


def among_scans(
    scans: Iterable[tuple[int, ScanToRender]], by_hand: ByHand, map_poses: Floats
) -> Iterator[ToRender]:
    """Scans, erased areas and walls in rendering order.

    scans       with the indices of their key frames, ascending; an area follows the scans it was erased from
    map_poses   (N, 3) of the key frames
    Walls come last. Areas of kind ERASED_AS_SEEN are omitted: their points are removed from the scans.
    """
    areas = [d for d in by_hand.drawings(map_poses) if d.kind in (ERASED, ERASED_TO_FREE)]
    areas.sort(key=lambda drawing: drawing.until)
    for k, scan in scans:
        while areas and areas[0].until <= k:
            yield _area(areas.pop(0))
        yield scan
    yield from map(_area, areas)
    yield from walls_of(by_hand, map_poses)


def _area(drawing: Drawing) -> AreaToErase:
    return AreaToErase(drawing.corners_map, drawing.kind == ERASED_TO_FREE)
