from service.kernels import tiles
from service.kernels.tiles import NO_TILE, take_slot
from tests.service.kernels.inner import from_python
from tests.service.kernels.surfel_grids import empty_grid

find_tile = from_python(tiles.find_tile)


def test_tiles_are_found_where_they_were_put_and_nowhere_else() -> None:
    tiles = empty_grid().tiles
    assert find_tile(tiles, -4, 3) == NO_TILE
    assert take_slot(tiles, -4, 3) == (0, False)
    assert find_tile(tiles, -4, 3) == 0
    assert find_tile(tiles, 3, -4) == NO_TILE


def test_places_outside_the_index_have_no_tile() -> None:
    tiles = empty_grid().tiles
    tiles.slots[:] = 5
    assert find_tile(tiles, -5, 0) == find_tile(tiles, 4, 0) == NO_TILE
    assert find_tile(tiles, 0, -5) == find_tile(tiles, 0, 4) == NO_TILE


def test_slots_handed_back_are_taken_first() -> None:
    tiles = empty_grid(used_slots=2).tiles
    assert take_slot(tiles, 0, 0) == (1, True)
    assert take_slot(tiles, 0, 1) == (0, True)
    assert take_slot(tiles, 0, 2) == (2, False)
