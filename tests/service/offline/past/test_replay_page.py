import struct
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from service.offline.past.replay_page import ReplayPage
from service.offline.replay.replay import ReplayOptions, replay, write_replay
from service.outputs import UNKNOWN
from tests.in_background import started
from tests.service.offline.recorded_drives import RecordDrive
from tests.service.web.conftest import TIMEOUT_S, talk

TILES, SCAN, PATH = 1, 2, 3
ANY_PORT = "127.0.0.1:0"


@pytest.fixture
def show() -> Iterator[Callable[..., ReplayPage]]:
    """Opens a page that is always closed again."""
    opened: list[ReplayPage] = []

    def open_one(rate: float = 0.0, is_paused: bool = False) -> ReplayPage:
        opened.append(ReplayPage(ANY_PORT, "lap", rate, is_paused))
        return opened[-1]

    yield open_one
    for page in opened:
        page.close()


def test_what_a_replay_writes_is_the_same_to_the_bit_with_and_without_the_page(
    record_drive: RecordDrive, show: Callable[..., ReplayPage], tmp_path: Path
) -> None:
    session = record_drive(scans=90, requests={60: "reset_map"})
    write_replay(replay([session], ReplayOptions()), tmp_path / "alone")
    write_replay(replay([session], ReplayOptions(), watch=show()), tmp_path / "watched")
    for name in ("trajectory.tum", "trajectory_live.tum", "states.csv", "graph.g2o", "map.pgm"):
        assert (tmp_path / "alone" / name).read_bytes() == (tmp_path / "watched" / name).read_bytes()


def test_the_page_shows_the_map_that_is_written_its_path_and_what_the_scans_saw(
    record_drive: RecordDrive, show: Callable[..., ReplayPage]
) -> None:
    page = show()
    done = replay([record_drive(scans=60)], ReplayOptions(), watch=page)

    async def look(client: Any) -> None:
        async with client.socket() as socket:
            hello = await client.next(socket, "hello")
            assert hello["vehicle"] == "lap"
            assert "replay_pause" in hello["verbs"]
            shown = cells_of(await client.next(socket, TILES))
            written = {(t.ix, t.iy): t.cells.tobytes() for t in done.tiles if (t.cells != UNKNOWN).any()}
            assert shown == written
            path = await path_of(client, socket)
            while len(path) < 2 or path[-1, 0] < 0.5:  # the first may be of a moment before the end
                path = await path_of(client, socket)
            ends = path[[0, -1]]
            np.testing.assert_allclose(ends, [[0.0, 0.0], [0.55, 0.0]], atol=0.06)
            by_name: dict[str, dict[str, str]] = {}
            while by_name.get("mapping", {}).get("state") != "finished":
                statuses = (await client.next(socket, "health"))["statuses"]
                by_name = {status["name"]: status["values"] for status in statuses}
            assert by_name["mapping"]["scans"] == "60"
            assert by_name["replay"]["state"] == "finished"
            assert by_name["replay"]["recording"].startswith("v_")
            assert "front" in (await client.next(socket, "mountings"))["pose_base_sensor"]
            assert await client.next(socket, SCAN)

    talk(page.server, look)


async def path_of(client: Any, socket: Any) -> Any:
    """The next whole path; stretches after it are skipped."""
    while (message := await client.next(socket, PATH))[1]:
        pass
    return np.frombuffer(message, "<f4", offset=8).reshape(-1, 2)


def cells_of(message: bytes) -> dict[tuple[int, int], bytes]:
    (edge,) = struct.unpack_from("<H", message, 2)
    (count,) = struct.unpack_from("<I", message, 8)
    body = zlib.decompress(message[12:])
    places = np.frombuffer(body, "<i4", 2 * count).reshape(-1, 2).tolist()
    cells = [body[8 * count + k * edge * edge : 8 * count + (k + 1) * edge * edge] for k in range(count)]
    return {(ix, iy): square for (ix, iy), square in zip(places, cells, strict=True)}


def test_a_replay_is_halted_sent_ahead_and_let_go_from_the_page(
    record_drive: RecordDrive, show: Callable[..., ReplayPage]
) -> None:
    """40 scans in 0.8 s of log time."""
    page = show(is_paused=True)
    session = record_drive()
    working = started(lambda: replay([session], ReplayOptions(), watch=page))

    async def steer(client: Any) -> None:
        async with client.socket() as socket:
            await client.ask(socket, type="command", n=1, verb="replay_resume", request={})
            assert "token" in (await client.next(socket, "answer"))["body"]["error"]
            await client.ask(socket, type="token", token=page.address.partition("#token=")[2])
            assert (await client.next(socket, "access"))["may_control"]

            async def command(verb: str, **request: Any) -> dict[str, Any]:
                await client.ask(socket, type="command", n=2, verb=verb, request=request)
                body: dict[str, Any] = (await client.next(socket, "answer"))["body"]
                return body

            async def state_of(wanted: str, least_s: float) -> dict[str, str]:
                while True:
                    for status in (await client.next(socket, "health"))["statuses"]:
                        values: dict[str, str] = status["values"]
                        if (
                            status["name"] == "replay"
                            and values["state"] == wanted
                            and float(values["position_s"]) >= least_s
                        ):
                            return values

            await state_of("paused", 0.0)
            assert (await command("replay_go_to", position_s=0.4))["ok"]
            values = await state_of("paused", 0.4)
            assert float(values["position_s"]) == pytest.approx(0.4, abs=0.021)
            pose = await client.next(socket, "pose")
            while pose["x_m"] < 0.17:  # before it is there
                pose = await client.next(socket, "pose")
            assert pose["x_m"] == pytest.approx(0.2, abs=0.03)  # half a metre a second
            backwards = await command("replay_go_to", position_s=0.1)
            assert "goes forward only" in backwards["error"]
            assert "less than or equal to 10000" in (await command("replay_rate", rate=1e9))["error"]
            assert "reset_map" not in (await command("reset_map"))["error"]
            assert (await command("replay_rate", rate=100.0))["ok"]
            assert not working.done()
            assert (await command("replay_resume"))["ok"]
            assert float((await state_of("finished", 0.7))["rate"]) == 100.0
            assert "finished" in (await command("replay_pause"))["error"]

    talk(page.server, steer)
    assert len(working.result(TIMEOUT_S).outputs) == 40
