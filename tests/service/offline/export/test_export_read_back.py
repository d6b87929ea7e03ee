"""Every format is read back by a program that has nothing to do with the one that wrote it."""

import sys
import xml.etree.ElementTree as ElementTree

import gtsam
import numpy as np
import pytest

from service.errors import CorridorError, InputError
from service.mapstore.picture import to_pixels
from service.offline.export.export import export
from service.offline.export.outlines import occupied_points, outlines
from service.offline.export.utm import to_utm
from tests.service.offline.export.conftest import CELL_M, PICTURE, POSES, REFERENCE, X_MIN_M, Y_MIN_M, cells


def in_utm(x_m, y_m):
    return to_utm(*REFERENCE.to_geodetic(x_m, y_m), 32, False)


def test_png_with_its_world_file_by_gdal(anchored, tmp_path):
    import rasterio

    export(anchored, "png", tmp_path / "hall.png")
    with rasterio.open(tmp_path / "hall.png") as raster:
        np.testing.assert_array_equal(raster.read(1), to_pixels(cells()))
        assert raster.crs.to_epsg() == 32632
        assert raster.xy(39, 0) == pytest.approx(in_utm(X_MIN_M + 0.25, Y_MIN_M + 0.25), abs=1e-3)
    (tmp_path / "hall.pgw").unlink()  # its .aux.xml alone places it, too
    with rasterio.open(tmp_path / "hall.png") as raster:
        assert raster.xy(39, 0) == pytest.approx(in_utm(X_MIN_M + 0.25, Y_MIN_M + 0.25), abs=1e-3)
    (anchored / "geo.json").unlink()
    export(anchored, "png", tmp_path / "hall.png")
    with rasterio.open(tmp_path / "hall.png") as raster:
        assert raster.crs is None
        assert raster.xy(39, 0) == pytest.approx((X_MIN_M + 0.25, Y_MIN_M + 0.25))


def test_geotiff_on_the_earth_by_gdal(anchored, tmp_path):
    import rasterio

    export(anchored, "geotiff", tmp_path / "hall.tif")
    with rasterio.open(tmp_path / "hall.tif") as raster:
        assert raster.crs.to_epsg() == 32632
        assert raster.nodata == 205
        np.testing.assert_array_equal(raster.read(1), to_pixels(cells()))
        for row, column in ((0, 0), (39, 0), (17, 59)):
            place = X_MIN_M + (column + 0.5) * CELL_M, Y_MIN_M + (39.5 - row) * CELL_M
            assert raster.xy(row, column) == pytest.approx(in_utm(*place), abs=1e-3)


def test_dxf_by_ezdxf(replayed, tmp_path):
    import ezdxf

    export(replayed, "dxf", tmp_path / "hall.dxf")
    first = (tmp_path / "hall.dxf").read_bytes()
    document = ezdxf.readfile(tmp_path / "hall.dxf")
    assert document.units == ezdxf.units.M
    assert not document.audit().errors
    space = document.modelspace()
    walls = [line for line in space.query("LWPOLYLINE") if line.dxf.layer == "WALLS"]
    assert [np.array(w.get_points("xy")).tolist() for w in walls] == [o.tolist() for o in outlines(PICTURE)]
    assert all(wall.closed for wall in walls)
    (path,) = [line for line in space.query("LWPOLYLINE") if line.dxf.layer == "TRAJECTORY"]
    assert path.get_points("xy") == [(p.x_m, p.y_m) for p in POSES]
    export(replayed, "dxf", tmp_path / "hall.dxf")
    assert (tmp_path / "hall.dxf").read_bytes() == first


def test_svg_is_to_scale_by_svgelements(replayed, tmp_path):
    import svgelements

    export(replayed, "svg", tmp_path / "hall.svg")
    drawing = svgelements.SVG.parse(tmp_path / "hall.svg", reify=True, ppi=25.4)  # a pixel is a millimetre
    by_id = {element.id: element for element in drawing.elements() if element.id}
    left, top, right, bottom = by_id["walls"].bbox()
    assert (right - left, bottom - top) == pytest.approx((38 * CELL_M * 10, 27 * CELL_M * 10), abs=0.1)
    left, _, right, _ = by_id["scale_bar"].bbox(with_stroke=False)
    words = [element.text for element in drawing.elements() if isinstance(element, svgelements.Text)]
    assert f"{(right - left) / 10:.0f} m" in words
    path = by_id["trajectory"]
    assert abs(path[-1].x - path[0].x) == pytest.approx(10 * (POSES[-1].x_m - POSES[0].x_m), abs=0.1)
    assert path[-1].y - path[0].y == pytest.approx(10 * (POSES[0].y_m - POSES[-1].y_m), abs=0.1)  # y upwards


@pytest.mark.parametrize(("is_known", "word"), [(True, "N"), (False, "y")])
def test_the_arrow_of_an_svg_points_north_where_that_is_known(anchored, tmp_path, is_known, word):
    """The map's x axis lies 30 deg counter-clockwise of east: north is 30 deg clockwise of its y axis."""
    if not is_known:
        (anchored / "geo.json").unlink()
    export(anchored, "svg", tmp_path / "hall.svg")
    root = ElementTree.parse(tmp_path / "hall.svg").getroot()
    arrow = next(element for element in root.iter() if element.get("id") == "north")
    assert arrow.get("transform").endswith(f"rotate({30.0 if is_known else 0.0:.3f})")
    assert [text.text for text in arrow.iter() if text.text] == [word]


def test_g2o_by_gtsam(replayed, tmp_path):
    export(replayed, "g2o", tmp_path / "hall.g2o")
    graph, poses = gtsam.readG2o(str(tmp_path / "hall.g2o"), False)
    assert (graph.size(), poses.size()) == (1, 2)
    assert poses.atPose2(1).x() == 1.5


def test_ply_by_plyfile(replayed, tmp_path):
    from plyfile import PlyData

    export(replayed, "ply", tmp_path / "hall.ply")
    vertex = PlyData.read(tmp_path / "hall.ply")["vertex"]
    points = np.column_stack([vertex[axis] for axis in "xyz"])
    np.testing.assert_allclose(points[:, :2], occupied_points(PICTURE), atol=1e-6)
    assert not points[:, 2].any()


def test_pcd_by_pypcd4(replayed, tmp_path):
    from pypcd4 import PointCloud

    export(replayed, "pcd", tmp_path / "hall.pcd")
    cloud = PointCloud.from_path(tmp_path / "hall.pcd")
    assert cloud.fields == ("x", "y", "z")
    np.testing.assert_allclose(cloud.numpy()[:, :2], occupied_points(PICTURE), atol=1e-6)


@pytest.mark.parametrize(("to", "module"), [("geotiff", "tifffile"), ("dxf", "ezdxf")])
def test_a_library_that_is_missing_is_named(replayed, tmp_path, monkeypatch, to, module):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(CorridorError, match=rf"needs {module}, .* -m pip install .*'{module}[<>]"):
        export(replayed, to, tmp_path / "hall")


def test_where_there_is_no_graph_it_says_how_to_get_one(replayed, tmp_path):
    (replayed / "graph.g2o").unlink()
    with pytest.raises(InputError, match=r"no graph\.g2o in it; its profile has no graph"):
        export(replayed, "g2o", tmp_path / "hall.g2o")
