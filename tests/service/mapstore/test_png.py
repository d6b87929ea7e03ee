import numpy as np

from service.mapstore.picture import picture_of_tiles
from service.mapstore.png import write_png
from tests.service.mapstore.tile_makers import tile


def test_another_program_reads_it_too(tmp_path):
    from PIL import Image

    picture = picture_of_tiles([tile(0, 0, 1), tile(3, 1, 2)])
    write_png(tmp_path / "map.png", picture)
    with Image.open(tmp_path / "map.png") as image:
        assert image.mode == "L"
        np.testing.assert_array_equal(np.asarray(image), np.vstack(list(picture.bands())))
