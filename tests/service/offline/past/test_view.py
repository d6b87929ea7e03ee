import json
import struct
import zlib

import numpy as np
import pytest

from service.errors import InputError
from service.geometry.se2 import SE2
from service.mapstore.files import save_map
from service.mapstore.picture import picture_of_grid
from service.mapstore.ros_map import write_ros_map
from service.offline.past.view import View
from service.offline.score.trajectory import write_tum
from service.outputs import FREE, OCCUPIED, UNKNOWN, Grid, TileUpdate
from tests.service.offline.maps.bent_maps import ROUND, save_bent
from tests.service.web.conftest import talk

TILES, GRAPH = 1, 4
ANY_PORT = "127.0.0.1:0"


@pytest.fixture
def show():
    """Opens a view that is always closed again."""
    opened = []

    def open_one(source, listen=ANY_PORT):
        opened.append(View(source, listen))
        return opened[-1]

    yield open_one
    for view in opened:
        view.close()


def grid(x_min_m: float, y_min_m: float) -> Grid:
    cells = np.full((70, 130), FREE, np.int8)
    cells[0, :], cells[:, 0] = OCCUPIED, UNKNOWN
    return Grid(0, 0.05, x_min_m, y_min_m, cells)


def test_a_stored_map_is_shown_as_it_was_saved_and_takes_no_command(show, tmp_path):
    tiles = [TileUpdate(0, ix, -1, ix + 1, 0.05, np.full((64, 64), 40 + ix, np.int8)) for ix in range(3)]
    save_map(tmp_path / "office", tiles, 1)

    async def look(client):
        async with client.socket() as socket:
            assert (await client.next(socket, "hello"))["vehicle"] == "office"
            assert struct.unpack_from("<I", await client.next(socket, TILES), 8) == (3,)
            (mapping,) = (await client.next(socket, "health"))["statuses"]
            assert mapping["values"]["state"] == "stored"

    talk(show(tmp_path / "office"), look)


def test_a_result_is_looked_at_where_the_vehicle_was_at_any_moment(show, tmp_path):
    write_ros_map(tmp_path / "map.pgm", tmp_path / "map.yaml", picture_of_grid(grid(0.0, 0.0)))
    write_tum(tmp_path / "trajectory.tum", [(k * 10**9 + 1, SE2(float(k), 0.5, 0.1)) for k in range(4)])
    view = show(tmp_path)

    async def look(client):
        async with client.socket() as socket:
            assert (await client.next(socket, "hello"))["verbs"] == ["moment_go_to"]
            last = await client.next(socket, "moment")
            assert (last["position_s"], last["duration_s"], last["path"]) == (3.0, 3.0, [0, 4])
            await client.ask(socket, type="token", token=view.token)
            for seconds, x_m, path in ((1.5, 1.0, [0, 2]), (0.0, 0.0, [0, 1]), (2.0, 2.0, [0, 3])):
                requested = {"position_s": seconds}
                await client.ask(socket, type="command", n=1, verb="moment_go_to", request=requested)
                moment = await client.next(socket, "moment")
                assert moment["position_s"] == pytest.approx(seconds)
                (pose,) = moment["poses"]
                assert (pose["x_m"], pose["y_m"], pose["theta_rad"]) == pytest.approx((x_m, 0.5, 0.1))
                assert pose["covariance"] == [None] * 9
                assert (moment["path"], moment["map_words"]) == (path, "map as it is in the end")
            await client.ask(socket, type="command", n=2, verb="map_look", request={})
            answers = [(await client.next(socket, "answer"))["body"] for _ in range(4)]
            assert "cannot be changed" in answers[-1]["error"]

    talk(view, look)


def test_a_moment_stays_when_the_map_is_edited_and_its_pose_goes_with_the_map(
    show, tmp_path, bent, monkeypatch
):
    graph = bent.graph
    rows = zip(graph.stamp_ns.tolist(), graph.map.tolist(), strict=True)
    write_tum(tmp_path / "trajectory.tum", [(stamp_ns, SE2(*pose)) for stamp_ns, pose in rows])
    save_bent(tmp_path / "map", bent)
    view, facts = show(tmp_path), []
    put_ready = view.server.put_ready
    monkeypatch.setattr(view.server, "put_ready", lambda ready: (facts.append(ready), put_ready(ready)))
    k = ROUND + 20
    requested = {"position_s": (graph.stamp_ns[k] - graph.stamp_ns[0]) / 1e9}
    assert view.answer("moment_go_to", json.dumps(requested).encode()).ok
    pairs = [
        {"points": points.tolist(), "keyframes": [near, near + ROUND]}
        for near in (6, 22)
        for points in bent.common_points(near)
    ]
    change = {"version": 1, "change": {"what": "add-pair", "pairs": pairs}}
    assert view.answer("map_edit", json.dumps(change).encode()).ok
    before, after = (json.loads(ready["moment"]) for ready in facts if "moment" in ready)
    assert before["position_s"] == after["position_s"] == pytest.approx(requested["position_s"])
    (was,), (now,) = before["poses"], after["poses"]
    assert (was["x_m"], was["y_m"]) == pytest.approx(tuple(graph.map[k, :2]), abs=1e-6)
    assert (now["x_m"], now["y_m"]) == pytest.approx(tuple(bent.truth[k, :2]), abs=0.1)
    assert np.hypot(now["x_m"] - was["x_m"], now["y_m"] - was["y_m"]) > 0.2


def test_the_graph_of_a_g2o_file_is_shown_with_its_loops(show, tmp_path):
    write_ros_map(tmp_path / "map.pgm", tmp_path / "map.yaml", picture_of_grid(grid(0.0, 0.0)))
    lines = [f"VERTEX_SE2 {k} {k} 0.5 0" for k in range(4)] + ["FIX 0"]
    lines += [f"EDGE_SE2 {k} {k + 1} 1 0 0 1 0 0 1 0 1" for k in range(3)] + [
        "EDGE_SE2 0 3 3 0 0 1 0 0 1 0 1"
    ]
    (tmp_path / "graph.g2o").write_text("\n".join(lines) + "\n")

    async def look(client):
        async with client.socket() as socket:
            body = zlib.decompress((await client.next(socket, GRAPH))[4:])
            assert struct.unpack_from("<5I", body) == (1, 0, 1, 0, 4)
            points = np.frombuffer(body, "<f4", count=12, offset=20).reshape(-1, 2).tolist()
            assert points == [[0.0, 0.5], [1.0, 0.5], [2.0, 0.5], [3.0, 0.5], [0.0, 0.5], [3.0, 0.5]]

    talk(show(tmp_path), look)
    with pytest.raises(InputError, match="no map in it"):
        View(tmp_path / "none", ANY_PORT)
    (tmp_path / "graph.g2o").write_text("VERTEX_SE2 0 here 0 0\n")
    with pytest.raises(InputError, match=r"graph\.g2o:1: .*no line of a g2o"):
        View(tmp_path, ANY_PORT)
