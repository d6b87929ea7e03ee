"""Maps and trajectories with their place on the earth, for programs that show maps of it."""

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path

from service.errors import InputError
from service.geometry.geo_reference import GeoReference
from service.geometry.geodesy import to_utm, utm_zone
from service.geometry.se2 import SE2
from service.mapstore.picture import Picture
from service.offline.outlines import Points
from service.version import VERSION

Poses = Sequence[tuple[int, SE2]]  # stamp_ns, pose_map_base

NS_PER_S = 1_000_000_000
DEGREES = "{:.8f}"  # 1 mm


def write_csv(path: Path, poses: Poses, reference: GeoReference | None) -> None:
    """A line a pose; without a reference the last three columns are not there. Raises OSError."""
    columns = "stamp_s,x_m,y_m,yaw_deg" + (",latitude_deg,longitude_deg,heading_deg" if reference else "")
    with path.open("w", encoding="ascii") as file:
        file.write(columns + "\n")
        for stamp_ns, pose in poses:
            line = f"{_seconds(stamp_ns)},{pose.x_m:.6f},{pose.y_m:.6f},{math.degrees(pose.theta_rad):.6f}"
            if reference is not None:
                place = ",".join(map(DEGREES.format, reference.to_geodetic(pose.x_m, pose.y_m)))
                line += f",{place},{reference.heading_deg(pose.theta_rad):.6f}"
            file.write(line + "\n")


def write_geojson(path: Path, poses: Poses, walls: Sequence[Points], reference: GeoReference) -> None:
    """The way as one LineString, walls as a MultiLineString of closed outlines; longitude before latitude.

    What crosses the meridian of 180 degrees is cut there; the way is a MultiLineString then. What is empty is
    left out. Source: RFC 7946, for the cut section 3.1.9. Raises OSError.
    """
    features = []
    if poses:
        about = {
            "name": "trajectory",
            "first_stamp_s": _seconds(poses[0][0]),
            "last_stamp_s": _seconds(poses[-1][0]),
            "position_sigma_m": round(reference.position_sigma_m, 3),
            "yaw_sigma_deg": round(math.degrees(reference.yaw_sigma_rad), 4),
            "fixes": reference.fixes,
        }
        way = _cut(_coordinates(poses, reference))
        one = len(way) == 1
        features.append(_feature("LineString" if one else "MultiLineString", way[0] if one else way, about))
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
    """The way as one line on the ground (OGC KML 2.3). Raises OSError."""
    places = " ".join(
        f"{longitude:.8f},{latitude:.8f},0" for longitude, latitude in _coordinates(poses, reference)
    )
    path.write_text(
        '<?xml version="1.0" encoding="UTF-8"?>\n<kml xmlns="http://www.opengis.net/kml/2.2"><Document>\n'
        f"<Placemark><name>trajectory</name><description>corridor {VERSION}; "
        f"{_seconds(poses[0][0])} to {_seconds(poses[-1][0])} s</description>\n"
        "<LineString><tessellate>1</tessellate><altitudeMode>clampToGround</altitudeMode>\n"
        f"<coordinates>{places}</coordinates></LineString></Placemark>\n</Document></kml>\n",
        encoding="ascii",
    )


Affine = tuple[float, float, float, float, float, float]  # A, D, B, E, C, F: x = A column + B row + C, ...


def write_world_file(picture_path: Path, picture: Picture, reference: GeoReference) -> tuple[Path, Path]:
    """NAME.pgw and NAME.prj beside NAME.png: where its pixels lie in UTM. Gives both paths.

    Source: ESRI, World files for raster datasets: six lines A, D, B, E, C, F.
    Raises OSError, and InputError where UTM ends.
    """
    zone, is_south, affine = utm_affine(picture_path, picture, reference)
    projection = picture_path.with_suffix(".prj")
    world = _write_affine(picture_path, affine)
    projection.write_text(_utm_wkt(zone, is_south) + "\n", encoding="ascii")
    return world, projection


def write_local_world_file(picture_path: Path, picture: Picture) -> Path:
    """NAME.pgw beside NAME.png: where its pixels lie in the map, m. Raises OSError."""
    cell_m = picture.cell_m
    left_m, top_m = picture.x_min_m + 0.5 * cell_m, picture.y_min_m + (picture.height - 0.5) * cell_m
    return _write_affine(picture_path, (cell_m, 0.0, 0.0, -cell_m, left_m, top_m))


def utm_affine(path: Path, picture: Picture, reference: GeoReference) -> tuple[int, bool, Affine]:
    """Zone, whether it is in the south, and what takes column and row to UTM, at the middles of pixels.

    Zone and hemisphere are those of the map's origin, wherever its corners are. One affine map stands for the
    whole picture: within 1 km UTM's scale changes by a few millionths.
    Raises InputError, which names `path`, where UTM ends.
    """
    latitude_deg, longitude_deg = reference.to_geodetic(0.0, 0.0)
    zone, is_south = utm_zone(longitude_deg), latitude_deg < 0.0
    left_m, low_m = picture.x_min_m, picture.y_min_m
    top_m, right_m = low_m + picture.height * picture.cell_m, left_m + picture.width * picture.cell_m
    try:
        corner, along, down = (
            to_utm(*reference.to_geodetic(*xy), zone, is_south)
            for xy in ((left_m, top_m), (right_m, top_m), (left_m, low_m))
        )
    except ValueError as error:
        raise InputError(f"{path}: no place in UTM: {error}") from error
    a, d = ((along[k] - corner[k]) / picture.width for k in (0, 1))
    b, e = ((down[k] - corner[k]) / picture.height for k in (0, 1))
    c, f = corner[0] + 0.5 * (a + b), corner[1] + 0.5 * (d + e)
    return zone, is_south, (a, d, b, e, c, f)


def _write_affine(picture_path: Path, affine: Affine) -> Path:
    world = picture_path.with_suffix(".pgw")
    world.write_text("".join(f"{value:.10f}\n" for value in affine), encoding="ascii")
    return world


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


def _seconds(stamp_ns: int) -> str:
    return f"{stamp_ns // NS_PER_S}.{stamp_ns % NS_PER_S:09d}"


def _utm_wkt(zone: int, is_south: bool) -> str:
    """As ESRI's .prj files have it: EPSG 32600 + zone, or 32700 + zone in the south."""
    name = f"WGS_1984_UTM_Zone_{zone}{'S' if is_south else 'N'}"
    parameters: Iterable[tuple[str, float]] = (
        ("False_Easting", 500000.0),
        ("False_Northing", 10000000.0 if is_south else 0.0),
        ("Central_Meridian", 6.0 * zone - 183.0),
        ("Scale_Factor", 0.9996),
        ("Latitude_Of_Origin", 0.0),
    )
    listed = ",".join(f'PARAMETER["{key}",{value}]' for key, value in parameters)
    return (
        f'PROJCS["{name}",GEOGCS["GCS_WGS_1984",DATUM["D_WGS_1984",SPHEROID["WGS_1984",6378137.0,298.257223563]],'
        'PRIMEM["Greenwich",0.0],UNIT["Degree",0.0174532925199433]],PROJECTION["Transverse_Mercator"],'
        f'{listed},UNIT["Meter",1.0]]'
    )
