from service.geometry.grid import TileRange, cell_of, tiles_of


def test_cells_below_zero_are_counted_downwards() -> None:
    assert [cell_of(x, 0.1) for x in (0.05, 0.15, -0.05, -0.15)] == [0, 1, -1, -2]


def test_tiles_cover_the_box_and_its_margin() -> None:
    tiles = tiles_of((-0.5, 0.1), (0.5, 3.3), cell_m=0.1, tile_bits=5)
    assert tiles == TileRange(first_row=0, first_column=-1, last_row=1, last_column=0)
    assert tiles.tile_count == 4
    assert tiles_of((-0.5, 0.1), (0.5, 3.3), 0.1, 5, margin_cells=2).first_row == -1
