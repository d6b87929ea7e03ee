"""Maps and trajectories with their place on the earth, for programs that show maps of it.

Source of GeoTIFF: OGC GeoTIFF standard 1.1 (OGC 19-008r4), its tags and its GeoKeys.
"""

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from xml.sax.saxutils import escape

import numpy as np

from service.errors import InputError
from service.extras import optional
from service.geometry.geo_reference import GeoReference
from service.geometry.se2 import SE2
from service.mapstore.picture import GREY_UNKNOWN, Picture
from service.offline.export.outlines import Points
from service.offline.export.utm import to_utm, utm_zone
from service.offline.score.trajectory import seconds_text
from service.version import VERSION

Poses = Sequence[tuple[int, SE2]]  # stamp_ns, pose_map_base

DEGREES = "{:.8f}"  # 1 mm
MODEL_TRANSFORMATION, GEO_KEYS, GEO_ASCII, GDAL_NODATA = 34264, 34735, 34737, 42113
MODEL_TYPE, RASTER_TYPE, CITATION, PROJECTED_CRS, LINEAR_UNITS = 1024, 1025, 1026, 3072, 3076
PROJECTED, USER_DEFINED, PIXEL_IS_AREA, METRE = 1, 32767, 1, 9001
UTM_NORTH, UTM_SOUTH = 32600, 32700  # EPSG, plus the zone
SHORT, ASCII, DOUBLE = 3, 2, 12


def write_csv(path: Path, poses: Poses, reference: GeoReference | None) -> None:
    """A line a pose; without a reference the last three columns are not there. Raises OSError."""
    columns = "stamp_s,x_m,y_m,yaw_deg" + (",latitude_deg,longitude_deg,heading_deg" if reference else "")
    with path.open("w", encoding="ascii") as file:
        file.write(columns + "\n")
        for stamp_ns, pose in poses:
            line = (
                f"{seconds_text(stamp_ns)},{pose.x_m:.6f},{pose.y_m:.6f},{math.degrees(pose.theta_rad):.6f}"
            )
            if reference is not None:
                place = ",".join(map(DEGREES.format, reference.to_geodetic(pose.x_m, pose.y_m)))
                line += f",{place},{reference.heading_deg(pose.theta_rad):.6f}"
            file.write(line + "\n")


def write_geojson(path: Path, poses: Poses, walls: Sequence[Points], reference: GeoReference) -> None:
    """The path as one LineString, walls as a MultiLineString of closed outlines; longitude before latitude.

    What crosses the meridian of 180 degrees is cut there; it is a MultiLineString then. What is empty is
    left out. Source: RFC 7946, for the cut section 3.1.9. Raises OSError.
    """
    features = []
    if poses:
        about = {
            "name": "trajectory",
            "first_stamp_s": seconds_text(poses[0][0]),
            "last_stamp_s": seconds_text(poses[-1][0]),
            "position_sigma_m": round(reference.position_sigma_m, 3),
            "yaw_sigma_deg": round(math.degrees(reference.yaw_sigma_rad), 4),
            "fixes": reference.fixes,
        }
        driven = _cut(_coordinates(poses, reference))
        one = len(driven) == 1
        features.append(
            _feature("LineString" if one else "MultiLineString", driven[0] if one else driven, about)
        )
    if walls:
        rings = [
            [_longitude_latitude(x, y, reference) for x, y in [*wall.tolist(), wall[0].tolist()]]
            for wall in walls
        ]
        lines = [line for ring in rings for line in _cut(ring)]
        features.append(_feature("MultiLineString", lines, {"name": "walls"}))
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}) + "\n", encoding="ascii")


def _feature(kind: str, coordinates: object, about: Mapping[str, object]) -> dict[str, object]:
    geometry = {"type": kind, "coordinates": coordinates}
    return {"type": "Feature", "geometry": geometry, "properties": about}


def write_kml(path: Path, poses: Poses, reference: GeoReference) -> None:
    """The path as one line on the ground (OGC KML 2.3). Raises OSError."""
    places = " ".join(
        f"{longitude:.8f},{latitude:.8f},0" for longitude, latitude in _coordinates(poses, reference)
    )
    path.write_text(
        '<?xml version="1.0" encoding="UTF-8"?>\n<kml xmlns="http://www.opengis.net/kml/2.2"><Document>\n'
        f"<Placemark><name>trajectory</name><description>corridor {VERSION}; "
        f"{seconds_text(poses[0][0])} to {seconds_text(poses[-1][0])} s</description>\n"
        "<LineString><tessellate>1</tessellate><altitudeMode>clampToGround</altitudeMode>\n"
        f"<coordinates>{places}</coordinates></LineString></Placemark>\n</Document></kml>\n",
        encoding="ascii",
    )


Affine = tuple[float, float, float, float, float, float]  # A, D, B, E, C, F: x = A column + B row + C, ...


def write_world_file(picture_path: Path, picture: Picture, reference: GeoReference | None) -> None:
    """NAME.pgw and NAME.png.aux.xml beside NAME.png: where its pixels lie, in UTM or, without a reference, in
    metres of the map. GDAL takes the coordinate system from the second; it reads no NAME.prj beside a PNG.

    Sources: ESRI, World files for raster datasets: six lines A, D, B, E, C, F; GDAL's PAM (gdalpam.xsd).
    Raises OSError, and InputError where UTM ends.
    """
    utm, (a, d, b, e, x, y) = placed(picture_path, picture, reference)
    srs = "" if utm is None else f'<SRS dataAxisToSRSAxisMapping="1,2">{escape(_utm_wkt(*utm))}</SRS>\n'
    text = "".join(f"{value:.10f}\n" for value in (a, d, b, e, x + 0.5 * (a + b), y + 0.5 * (d + e)))
    picture_path.with_suffix(".pgw").write_text(text, encoding="ascii")
    transform = ", ".join(f"{value:.10f}" for value in (x, a, b, y, d, e))
    picture_path.with_name(f"{picture_path.name}.aux.xml").write_text(
        f"<PAMDataset>\n{srs}<GeoTransform>{transform}</GeoTransform>\n</PAMDataset>\n", encoding="ascii"
    )


def placed(
    path: Path, picture: Picture, reference: GeoReference | None
) -> tuple[tuple[int, bool] | None, Affine]:
    """Zone of UTM and whether it is in the south, and what takes column and row to it, at the upper left
    corners of pixels. Without a reference None, and to metres of the map.

    Zone and hemisphere are those of the map's origin, wherever its corners are. One affine map stands for the
    complete picture: within 1 km UTM's scale changes by a few millionths.
    Raises InputError, which names `path`, where UTM ends.
    """
    left_m, low_m = picture.x_min_m, picture.y_min_m
    top_m, right_m = low_m + picture.height * picture.cell_m, left_m + picture.width * picture.cell_m
    if reference is None:
        return None, (picture.cell_m, 0.0, 0.0, -picture.cell_m, left_m, top_m)
    latitude_deg, longitude_deg = reference.to_geodetic(0.0, 0.0)
    zone, is_south = utm_zone(longitude_deg), latitude_deg < 0.0
    try:
        corner, along, down = (
            to_utm(*reference.to_geodetic(*xy), zone, is_south)
            for xy in ((left_m, top_m), (right_m, top_m), (left_m, low_m))
        )
    except ValueError as error:
        raise InputError(f"{path}: no place in UTM: {error}") from error
    a, d = ((along[k] - corner[k]) / picture.width for k in (0, 1))
    b, e = ((down[k] - corner[k]) / picture.height for k in (0, 1))
    return (zone, is_south), (a, d, b, e, corner[0], corner[1])


def _coordinates(poses: Poses, reference: GeoReference) -> list[tuple[float, float]]:
    """Longitude, latitude of each pose."""
    return [_longitude_latitude(pose.x_m, pose.y_m, reference) for _, pose in poses]


def _longitude_latitude(x_m: float, y_m: float, reference: GeoReference) -> tuple[float, float]:
    latitude, longitude = reference.to_geodetic(x_m, y_m)
    return round(longitude, 8), round(latitude, 8)


def _cut(line: Sequence[tuple[float, float]]) -> list[list[tuple[float, float]]]:
    """A line of longitudes and latitudes, cut at the meridian of 180 degrees: parts end on it."""
    parts = [[line[0]]]
    for (from_deg, latitude_deg), (to_deg, to_latitude_deg) in pairwise(line):
        if abs(to_deg - from_deg) > 180.0:
            side_deg = math.copysign(180.0, from_deg)
            share = (side_deg - from_deg) / ((to_deg - from_deg) % math.copysign(360.0, from_deg))
            at_deg = round(latitude_deg + share * (to_latitude_deg - latitude_deg), 8)
            parts[-1].append((side_deg, at_deg))
            parts.append([(-side_deg, at_deg)])
        parts[-1].append((to_deg, to_latitude_deg))
    return parts


def _utm_wkt(zone: int, is_south: bool) -> str:
    """WKT 1 of EPSG 32600 + zone, or 32700 + zone in the south."""
    parameters: Iterable[tuple[str, float]] = (
        ("latitude_of_origin", 0),
        ("central_meridian", 6 * zone - 183),
        ("scale_factor", 0.9996),
        ("false_easting", 500000),
        ("false_northing", 10000000 if is_south else 0),
    )
    listed = ",".join(f'PARAMETER["{key}",{value}]' for key, value in parameters)
    return (
        f'PROJCS["WGS 84 / UTM zone {zone}{"S" if is_south else "N"}",GEOGCS["WGS 84",DATUM["WGS_1984",'
        'SPHEROID["WGS 84",6378137,298.257223563,AUTHORITY["EPSG","7030"]],AUTHORITY["EPSG","6326"]],'
        'PRIMEM["Greenwich",0],UNIT["degree",0.0174532925199433],AUTHORITY["EPSG","4326"]],'
        f'PROJECTION["Transverse_Mercator"],{listed},UNIT["metre",1],AXIS["Easting",EAST],'
        f'AXIS["Northing",NORTH],AUTHORITY["EPSG","{(32700 if is_south else 32600) + zone}"]]'
    )


def write_geotiff(path: Path, picture: Picture, reference: GeoReference | None) -> None:
    """The pixels of the PGM, grey, unknown as nodata.

    reference   UTM on WGS 84, the zone of the map's origin; None: metres of the map, in no known place

    Raises OSError, InputError where UTM ends, CorridorError where tifffile is not installed.
    """
    tifffile = optional("tifffile", "export", "--format geotiff")
    utm, (a, d, b, e, x, y) = placed(path, picture, reference)
    citation, crs = "Frame of the map: metres, place on the earth unknown|", []
    if utm is not None:
        zone, is_south = utm
        citation = f"WGS 84 / UTM zone {zone}{'S' if is_south else 'N'}|"
        crs = [(PROJECTED_CRS, 0, 1, (UTM_SOUTH if is_south else UTM_NORTH) + zone)]
    keys = [
        (MODEL_TYPE, 0, 1, USER_DEFINED if utm is None else PROJECTED),
        (RASTER_TYPE, 0, 1, PIXEL_IS_AREA),
        (CITATION, GEO_ASCII, len(citation), 0),
        *crs,
        (LINEAR_UNITS, 0, 1, METRE),
    ]
    directory = [1, 1, 1, len(keys), *(value for key in keys for value in key)]
    matrix = [a, b, 0.0, x, d, e, 0.0, y, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]
    tifffile.imwrite(
        path,
        np.vstack(list(picture.bands())),
        photometric="minisblack",
        compression="zlib",
        software="corridor",
        metadata=None,
        extratags=[
            (MODEL_TRANSFORMATION, DOUBLE, 16, matrix, True),
            (GEO_KEYS, SHORT, len(directory), directory, True),
            (GEO_ASCII, ASCII, len(citation) + 1, citation, True),
            (GDAL_NODATA, ASCII, 4, str(GREY_UNKNOWN), True),
        ],
    )
