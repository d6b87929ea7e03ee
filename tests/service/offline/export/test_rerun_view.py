from pathlib import Path
from typing import Any

import numpy as np
import pytest

from service.cli import main
from service.errors import InputError, StorageError, UsageError
from service.geometry.se2 import SE2
from service.mapstore.picture import picture_of_grid
from service.mapstore.ros_map import write_ros_map
from service.offline.export.rerun_view import show_in_rerun
from service.offline.score.trajectory import write_tum
from service.outputs import FREE, OCCUPIED, UNKNOWN, Grid

S = 1_000_000_000


@pytest.fixture
def result(tmp_path: Path) -> Path:
    """Of a replay: a wall along the lowest row, four poses, a loop between the first and the last."""
    pytest.importorskip("rerun", reason="no rerun-sdk; with it: .venv/bin/pip install -e '.[rerun]'")
    folder = tmp_path / "result"
    folder.mkdir()
    cells = np.full((64, 128), FREE, np.int8)
    cells[0], cells[63] = OCCUPIED, UNKNOWN
    write_ros_map(folder / "map.pgm", folder / "map.yaml", picture_of_grid(Grid(0, 0.05, 3.2, -6.4, cells)))
    write_tum(folder / "trajectory.tum", [(k * S + 5, SE2(float(k), 0.5, np.pi / 2)) for k in range(4)])
    lines = [f"VERTEX_SE2 {k} {k} 0.5 0" for k in range(4)]
    lines += [f"EDGE_SE2 {of} {to} 1 0 0 1 0 0 1 0 1" for of, to in ((0, 1), (1, 2), (2, 3), (0, 3))]
    (folder / "graph.g2o").write_text("\n".join(lines) + "\n")
    return folder


def read(path: Path) -> dict[str, dict[str, Any]]:
    """Entity -> component -> values of its rows."""
    from rerun import chunk

    found: dict[str, dict[str, Any]] = {}
    for part in chunk.RrdReader(path).stream():
        batch = part.to_record_batch()
        found.setdefault(part.entity_path, {}).update(
            {name: _values(batch.column(name)) for name in batch.schema.names}
        )
    return found


def _values(column: Any) -> list[Any]:
    if str(column.type).startswith("timestamp"):  # ns, more than a datetime has
        return column.cast("int64").to_pylist()
    return column.to_pylist()


def test_map_path_and_graph_are_there_where_they_lie(
    result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out" / "result.rrd"
    assert main(["view", str(result), "--rerun", "--save", str(out), "--json"]) == 0
    assert f'"shown_in": "{out}"' in capsys.readouterr().out
    entities = read(out)
    grid = entities["/map/occupancy"]
    assert grid["GridMap:translation"] == [[pytest.approx([3.2, -6.4, 0.0])]]
    assert grid["GridMap:cell_size"] == [[pytest.approx(0.05)]]
    (((shape),),) = grid["GridMap:format"]
    assert (shape["width"], shape["height"]) == (128, 64)
    (((data),),) = grid["GridMap:data"]
    rows = np.frombuffer(bytes(data), np.int8).reshape(64, 128)
    assert set(rows[63].tolist()) == {OCCUPIED}  # an image begins above, the map's lowest row is its last
    assert set(rows[0].tolist()) == {UNKNOWN}
    ((path,),) = entities["/map/path"]["LineStrips3D:strips"]
    assert [point[:2] for point in path] == [[0.0, 0.5], [1.0, 0.5], [2.0, 0.5], [3.0, 0.5]]
    ((loop,),) = entities["/map/graph/loops"]["LineStrips3D:strips"]
    assert [point[:2] for point in loop] == [[0.0, 0.5], [3.0, 0.5]]
    vehicle = entities["/map/vehicle"]
    assert [origins[0][0] for origins in vehicle["Arrows3D:origins"]] == [0.0, 1.0, 2.0, 3.0]
    np.testing.assert_allclose(vehicle["Arrows3D:vectors"], [[[0.0, 1.0, 0.0]]] * 4, atol=1e-6)
    assert vehicle["stamp"] == [k * S + 5 for k in range(4)]


def test_what_cannot_be_shown_is_refused_in_words(result: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no map in it"):
        show_in_rerun(tmp_path, tmp_path / "a.rrd")
    with pytest.raises(StorageError, match="cannot write"):
        show_in_rerun(result, result / "map.pgm" / "a.rrd")
    assert main(["view", str(result), "--save", str(tmp_path / "a.rrd")]) == UsageError.exit_code
