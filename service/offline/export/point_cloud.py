"""Occupied cells as a point cloud. Sources: Turk, The PLY polygon file format; PCL, PCD file format 0.7."""

from pathlib import Path

import numpy as np

from service.mapstore.picture import Picture
from service.offline.export.outlines import occupied_points


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
