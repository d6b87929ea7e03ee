import numpy as np
import pytest
import yaml

from service.errors import InputError
from service.mapstore.picture import picture_of_grid, picture_of_tiles
from service.mapstore.ros_map import read_pgm, read_ros_map, write_ros_map
from service.outputs import Grid
from tests.service.mapstore.tile_makers import tile


@pytest.fixture
def written(tmp_path):
    picture = picture_of_tiles([tile(-1, 2, 1), tile(0, 0, 2)])
    write_ros_map(tmp_path / "map.pgm", tmp_path / "map.yaml", picture)
    return tmp_path


def test_the_yaml_says_what_map_server_wants_to_know(written):
    about = yaml.safe_load((written / "map.yaml").read_text())
    assert about == {
        "image": "map.pgm",
        "mode": "trinary",
        "resolution": 0.5,
        "origin": [-4.0, 0.0, 0.0],
        "negate": 0,
        "occupied_thresh": 0.65,
        "free_thresh": 0.196,
    }
    assert all(isinstance(value, float) for value in [about["resolution"], *about["origin"]])


def test_unknown_stays_unknown_for_a_reader_that_follows_map_server(written):
    """Source: nav2_map_server map_io.cpp: occupancy = (255 - pixel) / 255, free below free_thresh."""
    about = yaml.safe_load((written / "map.yaml").read_text())
    occupancy = (255 - 205) / 255
    assert about["free_thresh"] < occupancy < about["occupied_thresh"]


def test_a_map_reads_back_cell_by_cell(tmp_path):
    cells = np.random.default_rng(3).choice(np.array([-1, 0, 100], dtype=np.int8), size=(17, 31))
    write_ros_map(
        tmp_path / "m.pgm", tmp_path / "m.yaml", picture_of_grid(Grid(9, 0.025, -1.125, 1e-7, cells))
    )
    back = read_ros_map(tmp_path / "m.yaml")
    np.testing.assert_array_equal(back.cells, cells)
    assert (back.cell_m, back.x_min_m, back.y_min_m) == (0.025, -1.125, 1e-7)


def test_the_pgm_is_what_an_independent_reader_sees(written):
    from PIL import Image

    with Image.open(written / "map.pgm") as image:
        np.testing.assert_array_equal(np.asarray(image), read_pgm(written / "map.pgm"))


def test_comments_in_a_pgm_are_skipped(tmp_path):
    (tmp_path / "a.pgm").write_bytes(b"P5\n# CREATOR: gimp 2\n 3 # wide\n1\n255\n\x00\xcd\xfe")
    assert read_pgm(tmp_path / "a.pgm").tolist() == [[0, 205, 254]]


@pytest.mark.parametrize(
    ("content", "diagnostic"),
    [
        (b"P2\n1 1\n255\n0", "not with the header of a binary PGM"),
        (b"P5\n1", "not with the header of a binary PGM"),
        (b"P5\n2 2\n255\nabc", "2 x 2 pixels up to 255 in 3 bytes"),
        (b"P5\n1 1\n65535\nab", "up to 65535"),
    ],
)
def test_a_broken_pgm_is_refused_by_name(tmp_path, content, diagnostic):
    (tmp_path / "a.pgm").write_bytes(content)
    with pytest.raises(InputError, match=diagnostic) as caught:
        read_pgm(tmp_path / "a.pgm")
    assert str(tmp_path / "a.pgm") in str(caught.value)


@pytest.mark.parametrize(
    "change",
    [{"image": None}, {"origin": [0, 0]}, {"resolution": "wide"}, {"resolution": 0}, {"origin": [0, 0, 0.1]}],
)
def test_a_broken_yaml_is_refused_by_name(written, change):
    path = written / "map.yaml"
    path.write_text(yaml.safe_dump(yaml.safe_load(path.read_text()) | change))
    with pytest.raises(InputError, match=r"map\.yaml"):
        read_ros_map(path)
