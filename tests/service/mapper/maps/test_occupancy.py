import pickle

import numpy as np
import pytest

from service.geometry.se2 import SE2
from service.mapper.components import AreaToErase, ScanToRender, WallToRender
from service.mapper.maps.occupancy import OccupancyConfig, OccupancyTiles
from service.outputs import TileUpdate
from tests.service.mapper.maps.points import points_of, square

SECOND_NS = 1_000_000_000


def new_map(**changes: float) -> OccupancyTiles:
    return OccupancyTiles(OccupancyConfig.model_validate(changes), cell_m=0.05)


def cell(tiles: list[TileUpdate], x_m: float, y_m: float) -> int:
    column, row = int(np.floor(x_m / 0.05)), int(np.floor(y_m / 0.05))
    tile = next(t for t in tiles if (t.ix, t.iy) == (column // 64, row // 64))
    return int(tile.cells[row % 64, column % 64])


def test_a_room_is_free_inside_occupied_at_its_walls_and_unknown_beyond() -> None:
    shown = new_map()
    for k in range(5):
        shown.insert(square(2.01), SE2(0.2 * k, 0.0, 0.0) if k % 2 else SE2(0.2 * k, 0.0, 0.1))
        shown.insert(square(2.01, stamp_ns=(k + 1) * SECOND_NS), SE2())
    tiles = shown.changed_tiles()
    assert cell(tiles, 2.01, 0.5) > 80
    assert cell(tiles, 0.5, 0.5) < 20
    assert cell(tiles, -1.0, -1.0) < 20
    assert cell(tiles, -3.1, 0.0) == -1


def test_only_what_changed_is_handed_out_with_rising_versions() -> None:
    shown = new_map()
    shown.insert(points_of(np.array([[1.0, 0.01], [8.0, 0.01]])), SE2())
    first = shown.changed_tiles()
    assert sorted(t.ix for t in first) == [0, 1, 2]
    assert len({t.version for t in first}) == 3
    assert shown.changed_tiles() == []
    shown.insert(points_of(np.array([[1.0, 0.01]]), SECOND_NS), SE2())
    (second,) = shown.changed_tiles()
    assert second.ix == 0
    assert second.version > max(t.version for t in first)
    assert not second.cells.flags.writeable


@pytest.mark.parametrize(
    ("pose", "after_s", "is_new"),
    [
        (SE2(0.05, 0.0, 0.0), 0.1, False),
        (SE2(0.11, 0.0, 0.0), 0.1, True),
        (SE2(0.0, 0.0, 0.1), 0.1, True),
        (SE2(0.0, 0.0, 0.0), 0.6, True),
    ],
)
def test_a_scan_is_rendered_after_a_distance_a_turn_or_a_while(
    pose: SE2, after_s: float, is_new: bool
) -> None:
    shown = new_map()
    shown.insert(square(), SE2())
    shown.changed_tiles()
    shown.insert(square(stamp_ns=round(after_s * 1e9)), pose)
    assert bool(shown.changed_tiles()) == is_new


def test_a_rendered_map_takes_the_place_of_all_there_was_with_rising_versions() -> None:
    shown = new_map()
    shown.insert(points_of(np.array([[1.0, 0.01], [8.0, 0.01]])), SE2())
    first = shown.changed_tiles()
    wall = ScanToRender(np.array([[1.0, 0.01], [3.0, 0.01]], np.float32), (0.0, 0.0), SE2(0.0, 0.2, 0.0))
    late = ScanToRender(np.array([[1.0, 0.01]], np.float32), (0.0, 0.0), SE2(0.0, 1.0, 0.0))
    rendered_map = pickle.loads(pickle.dumps(shown.renderer)).render([wall])
    shown.replace_by(rendered_map, [late])
    shown.insert(points_of(np.empty((0, 2)), SECOND_NS), SE2())  # with the next scan, whatever it sees
    second = shown.changed_tiles()
    assert min(t.version for t in second) > max(t.version for t in first)
    assert cell(second, 3.0, 0.21) > 60
    assert cell(second, 1.0, 0.01) == -1  # as if it had never been rendered
    assert cell(second, 1.0, 1.01) > 60  # what the rendered map does not have
    assert (next(t for t in second if t.ix == 2).cells == -1).all()


ROOM = ScanToRender(square(2.01).xy_base.astype(np.float32), (0.0, 0.0), SE2())
GLASS = np.array([(1.0, -0.5), (1.0, 0.5)])
CORNER = np.array([(0.4, 0.4), (2.5, 0.4), (2.5, 2.5), (0.4, 2.5)])


def test_no_beam_clears_a_wall_that_a_person_drew() -> None:
    shown = new_map()
    shown.replace_by(shown.renderer.render([WallToRender(GLASS), ROOM, ROOM]), ())
    assert cell(shown.changed_tiles(), 1.0, 0.0) > 90
    for k in range(20):
        shown.insert(square(2.01, stamp_ns=(k + 1) * SECOND_NS), SE2())
        shown.changed_tiles()
        assert all(cell(shown.tiles(), 1.0, y_m) > 90 for y_m in (-0.4, 0.0, 0.4))
    assert cell(shown.tiles(), 0.8, 0.0) < 10
    assert cell(shown.tiles(), 1.0, 0.0) > 90


@pytest.mark.parametrize(("is_free", "expected"), [(True, 3), (False, -1)])
def test_what_was_erased_is_gone_and_later_scans_are_rendered(is_free: bool, expected: int) -> None:
    shown = new_map()
    erased = [ROOM, ROOM, AreaToErase(CORNER, is_free)]
    shown.replace_by(shown.renderer.render(erased), ())
    tiles = shown.changed_tiles()
    assert cell(tiles, 2.01, 1.0) == cell(tiles, 1.0, 1.0) == expected
    assert cell(tiles, 2.01, -1.0) > 90
    shown.replace_by(shown.renderer.render([*erased, ROOM, ROOM, ROOM, ROOM, ROOM, ROOM]), ())
    assert cell(shown.changed_tiles(), 2.01, 1.0) > 70
