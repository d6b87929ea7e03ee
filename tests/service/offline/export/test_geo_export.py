"""Exported paths and maps on the earth lie where the reference places them."""

import csv
import json
import math
import xml.etree.ElementTree as ElementTree

import pytest

from service.errors import InputError
from service.geometry.geo_reference import GeoReference, LocalFrame
from service.geometry.se2 import SE2
from service.mapstore.geo_file import write_geo
from service.offline.export.export import export
from service.offline.score.trajectory import write_tum
from tests.service.offline.export.conftest import POSES, REFERENCE

POLAR = GeoReference(LocalFrame(89.0, 0.0, 0.0), SE2(), 0.8, 0.01, 41)


def earth(pose: SE2) -> tuple[float, float]:
    return REFERENCE.to_geodetic(pose.x_m, pose.y_m)


def test_geojson_and_kml_are_a_line_of_longitude_and_latitude(anchored, tmp_path):
    export(anchored, "geojson", tmp_path / "path.geojson")
    feature, *_ = json.loads((tmp_path / "path.geojson").read_text())["features"]
    assert feature["geometry"]["type"] == "LineString"
    export(anchored, "kml", tmp_path / "path.kml")
    root = ElementTree.parse(tmp_path / "path.kml").getroot()
    text = root.find(".//{http://www.opengis.net/kml/2.2}coordinates").text
    places = [place.split(",") for place in text.split()]
    for line in (feature["geometry"]["coordinates"], places):
        for (longitude, latitude, *_), pose in zip(line, POSES, strict=True):
            assert (float(latitude), float(longitude)) == pytest.approx(earth(pose), abs=1e-8)
    assert feature["properties"]["first_stamp_s"] == "1700000000.000000001"
    assert feature["properties"]["position_sigma_m"] == 0.8


def test_geojson_is_cut_where_it_crosses_the_meridian_of_180_degrees(anchored, tmp_path):
    """RFC 7946, section 3.1.9: without the cut a viewer draws a line around the earth."""
    fiji = GeoReference(LocalFrame(-17.0, 179.99998, 5.0), SE2(), 0.8, 0.01, 41)
    write_geo(anchored / "geo.json", fiji)
    there_and_back = [SE2(x_m, 0.4 * x_m) for x_m in (0.0, 1.0, 3.0, 5.0, 2.0, 0.5)]  # it lies 2.1 m east
    write_tum(anchored / "trajectory.tum", zip(range(6), there_and_back, strict=True))
    export(anchored, "geojson", tmp_path / "path.geojson")
    path, *_ = json.loads((tmp_path / "path.geojson").read_text())["features"]
    assert path["geometry"]["type"] == "MultiLineString"
    out, beyond, back = path["geometry"]["coordinates"]
    assert (len(out), len(beyond), len(back)) == (3, 4, 3)
    for line, side_deg in ((out, 180.0), (beyond, -180.0), (back, 180.0)):
        assert all(179.9999 < longitude / math.copysign(1.0, side_deg) <= 180.0 for longitude, _ in line)
    assert (out[-1][0], beyond[0][0], beyond[-1][0], back[0][0]) == (180.0, -180.0, -180.0, 180.0)
    assert out[-1][1] == beyond[0][1]
    east_m, north_m, _ = fiji.origin.to_enu(out[-1][1], out[-1][0], 5.0)
    assert north_m == pytest.approx(0.4 * east_m, abs=2e-3)


def test_csv_has_both_frames_and_the_compass(anchored, tmp_path):
    export(anchored, "csv", tmp_path / "path.csv")
    rows = list(csv.DictReader((tmp_path / "path.csv").read_text().splitlines()))
    assert [row["stamp_s"] for row in rows[:2]] == ["1700000000.000000001", "1700000000.020000004"]
    assert float(rows[4]["x_m"]) == 10.0
    place = float(rows[4]["latitude_deg"]), float(rows[4]["longitude_deg"])
    assert place == pytest.approx(earth(POSES[4]), abs=1e-8)
    assert float(rows[0]["heading_deg"]) == pytest.approx(60.0)  # 30 degrees north of east


@pytest.mark.parametrize(
    ("geo", "to", "words"),
    [
        (None, "geojson", r"no geo.json in it: .* which geojson needs.*summary\.json"),
        (None, "kml", r"no geo.json in it: .* which kml needs.*summary\.json"),
        ("{}", "csv", r'geo\.json: no geo-reference: expected an object whose "datum"'),
        (json.dumps(POLAR.as_dict()), "png", "UTM ends at 84 degrees"),
    ],
)
def test_what_no_place_on_the_earth_can_be_given_is_refused_in_words(anchored, tmp_path, geo, to, words):
    (anchored / "geo.json").unlink()
    if geo is not None:
        (anchored / "geo.json").write_text(geo)
    with pytest.raises(InputError, match=words):
        export(anchored, to, tmp_path / f"path.{to}")
    assert not (tmp_path / f"path.{to}").exists()
