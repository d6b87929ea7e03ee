"""What a replay leaves in its folder, with a map that lies on the earth or nowhere."""

import math
from pathlib import Path

import numpy as np
import pytest

from service.geometry.geo_reference import GeoReference, LocalFrame
from service.geometry.se2 import SE2
from service.mapstore.geo_file import write_geo
from service.mapstore.picture import picture_of_grid
from service.mapstore.ros_map import write_ros_map
from service.offline.score.trajectory import write_tum
from service.outputs import FREE, OCCUPIED, UNKNOWN, Grid

CELL_M, X_MIN_M, Y_MIN_M = 0.5, -4.0, -9.0
REFERENCE = GeoReference(
    LocalFrame(48.1, 11.6, 520.0), SE2(12.0, -7.0, math.radians(30.0)), 0.8, math.radians(0.3), 41
)
POSES = [SE2(3.0 * k - 2.0, -1.0 * k, 0.1 * k) for k in range(5)]
STAMPS = [1_700_000_000_000_000_001 + k * 20_000_003 for k in range(5)]
G2O = "VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1.5 0.25 0.5\nEDGE_SE2 0 1 1.5 0.25 0.5 100 0 0 100 0 400\n"


def cells() -> np.ndarray:
    grid = np.full((40, 60), FREE, dtype=np.int8)
    grid[:, 50:] = UNKNOWN
    grid[3:5, 2:40] = grid[20:30, 10:12] = OCCUPIED
    return grid


PICTURE = picture_of_grid(Grid(1, CELL_M, X_MIN_M, Y_MIN_M, cells()))


@pytest.fixture
def replayed(tmp_path: Path) -> Path:
    folder = tmp_path / "replayed"
    folder.mkdir()
    write_ros_map(folder / "map.pgm", folder / "map.yaml", PICTURE)
    write_tum(folder / "trajectory.tum", zip(STAMPS, POSES, strict=True))
    (folder / "graph.g2o").write_text(G2O)
    return folder


@pytest.fixture
def anchored(replayed: Path) -> Path:
    write_geo(replayed / "geo.json", REFERENCE)
    return replayed
