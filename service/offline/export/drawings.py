"""A map as a drawing, SVG for print and office programs, DXF for CAD; and as a point cloud.

Sources of the latter: Turk, The PLY polygon file format; PCL, PCD file format 0.7.
"""

import logging
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from service.extras import optional
from service.geometry.geo_reference import GeoReference
from service.geometry.se2 import SE2
from service.mapstore.annotated import scale_bar_m
from service.mapstore.picture import Picture
from service.offline.export.outlines import Points, occupied_points, outlines

MM_A_METRE = 10.0  # printed as it is, the plan is 1 : 100
MARGIN = 0.06  # of the longer side, around the walls
BAR_SHARE = 0.2  # of the width: about how long the scale bar is


def write_svg(path: Path, picture: Picture, poses: Sequence[SE2], reference: GeoReference | None) -> None:
    """Walls, the path driven, the map's origin, a scale bar and a north arrow, at 1 : 100, y upwards.

    poses      pose_map_base, may be empty
    reference  None: north is unknown, and the arrow shows the map's y axis instead

    Raises OSError.
    """
    walls = outlines(picture)
    driven = np.array([(pose.x_m, pose.y_m) for pose in poses]).reshape(-1, 2)
    points = np.vstack([*walls, driven, np.zeros((1, 2))])
    low, high = points.min(axis=0), points.max(axis=0)
    margin = MARGIN * float((high - low).max()) + 0.5
    low, high = low - margin, high + margin
    width, height = (high - low).tolist()
    text_m = max(width, height) / 60.0
    line_m = text_m / 8.0
    origin = _svg(np.zeros((1, 2)), low, high)[0]
    bar_m = scale_bar_m(width, BAR_SHARE)
    foot = height - margin / 2.0
    arrow = (width - margin / 2.0 - text_m, margin / 2.0 + 2.0 * text_m)
    turn_deg = math.degrees(reference.pose_enu_map.theta_rad) if reference is not None else 0.0
    elements = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width * MM_A_METRE:.1f}mm" '
        f'height="{height * MM_A_METRE:.1f}mm" viewBox="0 0 {width:.4f} {height:.4f}" '
        f'font-family="sans-serif" font-size="{text_m:.4f}" stroke-width="{line_m:.4f}">',
        "<title>Map in metres, 1 : 100</title>",
        f'<rect width="{width:.4f}" height="{height:.4f}" fill="white"/>',
        f'<path id="walls" fill="black" fill-rule="evenodd" stroke="none" d="{_paths(walls, low, high)}"/>',
    ]
    if len(driven) > 1:
        line = " ".join(f"{x:.3f},{y:.3f}" for x, y in _svg(driven, low, high))
        elements.append(f'<polyline id="trajectory" fill="none" stroke="#1f6fb4" points="{line}"/>')
    elements += [
        f'<path id="origin" stroke="#c03028" d="M{origin[0]:.3f} {origin[1]:.3f}h{text_m:.3f}'
        f'M{origin[0]:.3f} {origin[1]:.3f}v{-text_m:.3f}"/>',
        f'<text x="{origin[0] + line_m:.3f}" y="{origin[1] + text_m:.3f}" fill="#c03028">0</text>',
        f'<path id="scale_bar" stroke="black" d="M{margin / 2:.3f} {foot:.3f}h{bar_m:g}"/>',
        f'<text x="{margin / 2:.3f}" y="{foot - text_m / 2:.3f}">{bar_m:g} m</text>',
        f'<g id="north" transform="translate({arrow[0]:.3f} {arrow[1]:.3f}) rotate({turn_deg:.3f})">'
        f'<path d="M0 {-1.5 * text_m:.3f}L{text_m / 2:.3f} {text_m:.3f}L0 {text_m / 2:.3f}'
        f'L{-text_m / 2:.3f} {text_m:.3f}Z"/><text y="{-1.8 * text_m:.3f}" text-anchor="middle">'
        f"{'N' if reference is not None else 'y'}</text></g>",
        "</svg>",
    ]
    path.write_text("\n".join(elements) + "\n", encoding="utf-8")


def write_dxf(path: Path, picture: Picture, poses: Sequence[SE2]) -> None:
    """Closed polylines on layer WALLS, the path on TRAJECTORY, the origin on ORIGIN; units are metres.

    Raises OSError, and CorridorError where ezdxf is not installed.
    """
    ezdxf = optional("ezdxf", "export", "--format dxf")
    logging.getLogger("ezdxf").setLevel(logging.WARNING)  # it logs every dictionary it makes
    # No time and no random number: same map, same file.
    ezdxf.options.write_fixed_meta_data_for_testing = True
    document = ezdxf.new("R2010")
    document.units = ezdxf.units.M
    for name, colour in (("WALLS", 7), ("TRAJECTORY", 5), ("ORIGIN", 1)):
        document.layers.add(name, color=colour)
    space = document.modelspace()
    for wall in outlines(picture):
        space.add_lwpolyline(wall.tolist(), close=True, dxfattribs={"layer": "WALLS"})
    if len(poses) > 1:
        driven = [(pose.x_m, pose.y_m) for pose in poses]
        space.add_lwpolyline(driven, dxfattribs={"layer": "TRAJECTORY"})
    space.add_line((0.0, 0.0), (1.0, 0.0), dxfattribs={"layer": "ORIGIN"})
    space.add_line((0.0, 0.0), (0.0, 1.0), dxfattribs={"layer": "ORIGIN"})
    document.saveas(path)


def _svg(points: Points, low: Points, high: Points) -> Points:
    """m of the map to m from the upper left corner of the sheet."""
    return np.column_stack((points[:, 0] - low[0], high[1] - points[:, 1]))


def _paths(walls: Sequence[Points], low: Points, high: Points) -> str:
    return "".join(
        "M" + "L".join(f"{x:.3f} {y:.3f}" for x, y in _svg(wall, low, high)) + "Z" for wall in walls
    )


def write_ply(path: Path, picture: Picture) -> None:
    """Middles of occupied cells, m in the map, z = 0; binary, little endian. Raises OSError."""
    points = _points(picture)
    header = (
        "ply\nformat binary_little_endian 1.0\ncomment corridor: occupied cells, metres, map frame\n"
        f"element vertex {len(points)}\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
    )
    path.write_bytes(header.encode("ascii") + points.tobytes())


def write_pcd(path: Path, picture: Picture) -> None:
    """The same points. Raises OSError."""
    points = _points(picture)
    header = (
        "# .PCD v0.7 - corridor: occupied cells, metres, map frame\nVERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\n"
        f"TYPE F F F\nCOUNT 1 1 1\nWIDTH {len(points)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\n"
        f"POINTS {len(points)}\nDATA binary\n"
    )
    path.write_bytes(header.encode("ascii") + points.tobytes())


def _points(picture: Picture) -> np.ndarray[tuple[int, int], np.dtype[np.float32]]:
    plane = occupied_points(picture)
    return np.column_stack((plane, np.zeros(len(plane)))).astype("<f4")
