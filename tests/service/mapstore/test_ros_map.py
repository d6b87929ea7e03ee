from pathlib import Path

import numpy as np
import pytest
import yaml
from PIL import Image

from service.errors import InputError
from service.mapstore.picture import picture_of_grid, picture_of_tiles
from service.mapstore.ros_map import read_ros_map, write_ros_map
from service.outputs import Grid
from tests.service.mapstore.tile_makers import tile


@pytest.fixture
def written(tmp_path):
    picture = picture_of_tiles([tile(-1, 2, 1), tile(0, 0, 2)])
    write_ros_map(tmp_path / "map.pgm", tmp_path / "map.yaml", picture)
    return tmp_path


def test_a_map_reads_back_cell_by_cell(tmp_path):
    cells = np.random.default_rng(3).choice(np.array([-1, 0, 100], dtype=np.int8), size=(17, 31))
    write_ros_map(
        tmp_path / "m.pgm", tmp_path / "m.yaml", picture_of_grid(Grid(9, 0.025, -1.125, 1e-7, cells))
    )
    back = read_ros_map(tmp_path / "m.yaml")
    np.testing.assert_array_equal(back.cells, cells)
    assert (back.cell_m, back.x_min_m, back.y_min_m) == (0.025, -1.125, 1e-7)


@pytest.mark.parametrize(
    "name", ["a: b", "a #b", "[a]", "- a", "&a", "no", "1e3", "h\u00e4lle", "h\udce4lle"]
)
def test_a_map_of_any_name_is_named_by_its_yaml(tmp_path, name):
    pgm, about = tmp_path / f"{name}.pgm", tmp_path / f"{name}.yaml"
    write_ros_map(pgm, about, picture_of_tiles([tile(0, 0, 1)]))
    assert yaml.safe_load(about.read_bytes())["image"] == pgm.name


def map_of(folder: Path, image: Image.Image | bytes, name: str = "map.png", **about: object) -> Path:
    """A picture and its YAML, of cells of 0.5 m."""
    if isinstance(image, bytes):
        (folder / name).write_bytes(image)
    else:
        image.save(folder / name)
    thresholds = {"negate": 0, "occupied_thresh": 0.65, "free_thresh": 0.25}
    whole = {"image": name, "resolution": 0.5, "origin": [-1.0, 2.0, 0.0], **thresholds, **about}
    (folder / "map.yaml").write_text(yaml.safe_dump(whole))
    return folder / "map.yaml"


def cells_of(*arguments: object, **about: object) -> list[list[int]]:
    """Top row first, as in the picture."""
    return read_ros_map(map_of(*arguments, **about)).cells[::-1].tolist()


GREYS = np.array([[0, 60, 89, 90, 190], [191, 192, 205, 254, 255]], np.uint8)


def test_the_mode_scale_has_every_occupancy_between_the_thresholds(tmp_path):
    scaled = [[round((1 - p / 255 - 0.25) / 0.4 * 100) for p in row] for row in GREYS.tolist()]
    expected = np.clip(scaled, 0, 100).tolist()
    assert expected[0][3:] == [99, 1]
    assert cells_of(tmp_path, Image.fromarray(GREYS), mode="scale") == expected


@pytest.mark.parametrize("name", ["map_mode_raw", "map_origin_yaw"])
def test_maps_of_others_are_read_cell_by_cell(shared, name):
    with Image.open(shared / "cases" / name / "map.pgm") as image:
        pixels = np.asarray(image)[::-1].astype(np.int16)
    grid = read_ros_map(shared / "cases" / name / "map.yaml")
    if name == "map_mode_raw":
        expected = np.where(pixels == 255, -1, pixels)
        assert (grid.x_min_m, grid.y_min_m) == (-1.0, -2.0)
    else:  # turned by 90 deg: its rows run along -x
        expected = np.where(pixels == 254, 0, np.where(pixels == 205, -1, 100))[::-1].T
        assert (grid.x_min_m, grid.y_min_m) == pytest.approx((-1.0 - 20 * 0.05, -2.0), abs=1e-4)
    np.testing.assert_array_equal(grid.cells, expected)


def test_opacity_is_one_more_channel_in_trinary_and_makes_unknown_in_scale(tmp_path):
    pixels = np.array([[[0, 0, 0, 255], [0, 0, 0, 0], [255, 255, 255, 255], [255, 255, 255, 0]]], np.uint8)
    assert cells_of(tmp_path, Image.fromarray(pixels)) == [[100, 100, 0, -1]]
    assert cells_of(tmp_path, Image.fromarray(pixels), mode="scale") == [[100, -1, 0, -1]]
    assert cells_of(tmp_path, Image.fromarray(pixels), mode="raw") == [[0, 0, -1, -1]]
    grey = Image.fromarray(np.array([[[0, 255], [0, 0], [255, 254]]], np.uint8))
    assert cells_of(tmp_path, grey, mode="scale") == [[100, -1, -1]]
    indexed = Image.fromarray(np.array([[0, 1]], np.uint8), "P")
    indexed.putpalette([0, 0, 0, 0, 0, 0])
    indexed.info["transparency"] = 1
    assert cells_of(tmp_path, indexed, mode="scale") == [[100, -1]]


def test_16_bit_greys_are_read_to_their_last_bit(tmp_path):
    levels = np.array([[0, 22936, 22939, 49149, 49152, 65535]], np.uint16)  # thresholds: 22937.25, 49151.25
    for image, name in (
        (Image.fromarray(levels), "map.png"),
        (b"P5\n6 1\n65535\n" + levels.astype(">u2").tobytes(), "map.pgm"),
    ):
        assert cells_of(tmp_path, image, name) == [[100, 100, -1, -1, 0, 0]]
        assert cells_of(tmp_path, image, name, mode="raw") == [[0, 89, 89, -1, -1, -1]]


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (b"P2\n# CREATOR: gimp 2\n 3 # wide\n1\n255\n0 205\n254\n", [[100, 0, 0]]),
        (b"P5\n# CREATOR: gimp 2\n 3 # wide\n1\n255\n\x00\xcd\xfe", [[100, 0, 0]]),
        (b"P5 3 1 100 \x00\x32\x64", [[100, -1, 0]]),
        (b"P2 3 1 1023 0 500 1023", [[100, -1, 0]]),
    ],
)
def test_headers_and_depths_of_a_pgm(tmp_path, content, expected):
    assert cells_of(tmp_path, content, "map.pgm") == expected


def test_a_right_angle_keeps_every_cell(tmp_path):
    pixels = np.random.default_rng(1).choice(np.array([0, 205, 254], np.uint8), (7, 11))
    straight = read_ros_map(map_of(tmp_path, Image.fromarray(pixels), free_thresh=0.196)).cells
    for turns in (1, 2, 3, -1):
        about = {"origin": [0.0, 0.0, round(turns * np.pi / 2, 4)], "free_thresh": 0.196}
        grid = read_ros_map(map_of(tmp_path, Image.fromarray(pixels), **about))
        np.testing.assert_array_equal(grid.cells[::-1], np.rot90(straight[::-1], turns))


@pytest.mark.parametrize(
    ("content", "diagnostic"),
    [
        (b"P5\n1", "can be read"),
        (b"P5\n2 2\n255\nabc", "truncated"),
        (b"\x89PNG\r\n\x1a\n", "can be read"),
        (b"GIF89a", "no PGM, PNG or BMP"),
        (b"", "no PGM, PNG or BMP"),
        (b"P5 200000 200000 255 ", "40000000000 bytes, at most 1073741824 are read; CORRIDOR_FILE_LIMITS=38"),
    ],
)
def test_a_picture_that_cannot_be_read_is_refused_by_name(tmp_path, content, diagnostic):
    with pytest.raises(InputError, match=diagnostic) as caught:
        read_ros_map(map_of(tmp_path, content, "a.pgm"))
    assert str(tmp_path / "a.pgm") in str(caught.value)


@pytest.mark.parametrize(
    "change",
    [
        {"image": None},
        {"origin": [0, 0]},
        {"origin": [0, 0, float("nan")]},
        {"resolution": "wide"},
        {"resolution": 0},
        {"mode": "binary"},
        {"free_thresh": float("nan")},
        {"mode": "scale", "free_thresh": 0.7},
        {"negate": "maybe"},
    ],
)
def test_a_broken_yaml_is_refused_by_name(written, change):
    path = written / "map.yaml"
    path.write_text(yaml.safe_dump(yaml.safe_load(path.read_text()) | change))
    with pytest.raises(InputError, match=r"map\.yaml"):
        read_ros_map(path)
