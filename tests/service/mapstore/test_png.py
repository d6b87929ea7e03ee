import numpy as np
from PIL import Image

from service.mapstore.picture import picture_of_tiles
from service.mapstore.png import write_png
from tests.service.mapstore.tile_makers import tile


def test_another_program_reads_it_pixel_by_pixel(tmp_path):
    picture = picture_of_tiles([tile(x, y, 1 + x + 9 * y) for x in range(9) for y in range(7)])
    write_png(tmp_path / "map.png", picture)
    with Image.open(tmp_path / "map.png") as image:
        assert image.mode == "L"
        np.testing.assert_array_equal(np.asarray(image), np.vstack(list(picture.bands())))
