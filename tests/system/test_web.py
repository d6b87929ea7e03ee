"""The operator's page of a live service tells what Zenoh tells, and its commands take hold."""

import asyncio
import struct
import zlib
from collections.abc import Callable

import aiohttp
import numpy as np

from service.encoding import decode_diagnostics, decode_grid, decode_pose
from tests.service.web.conftest import Client
from tests.system.machine import PATIENCE_S, LiveService, Subscriber

TILES = 1


def tiles_in(payload: bytes) -> dict[tuple[int, int], np.ndarray]:
    _, _, edge, _, count = struct.unpack_from("<BBHfI", payload)
    body = zlib.decompress(payload[12:])
    places = np.frombuffer(body, "<i4", 2 * count).reshape(-1, 2).tolist()
    cells = np.frombuffer(body, np.int8, offset=8 * count).reshape(count, edge, edge)
    return {(ix, iy): square for (ix, iy), square in zip(places, cells, strict=True)}


def test_the_page_shows_what_zenoh_publishes(
    live_service: LiveService, subscribe: Callable[[str], Subscriber]
):
    subscriber = subscribe(live_service.endpoint)
    subscriber.wait_for("pose", 25)
    subscriber.wait_for("health", 1)
    (web,) = [s for s in decode_diagnostics(subscriber.heard["health"][-1][1]) if s.name == "web"]
    assert web.level == 0, web.message
    token = (live_service.config.parent / "web.token").read_text().strip()
    shown: dict[tuple[int, int], np.ndarray] = {}
    poses = []

    async def look() -> None:
        async with aiohttp.ClientSession() as session:
            client = Client(session, web.values["address"])
            async with asyncio.timeout(2 * PATIENCE_S), client.socket() as socket:
                poses.extend([await client.next(socket, "pose") for _ in range(20)])
                await client.ask(socket, type="token", token=token)
                assert (await client.next(socket, "access"))["may_control"]
                await client.ask(socket, type="command", n=1, verb="mark", request={"text": "seen"})
                assert (await client.next(socket, "answer"))["body"]["ok"]
                await client.ask(socket, type="command", n=2, verb="pause")
                assert (await client.next(socket, "answer"))["body"] == {"ok": True, "changed": True}
                await client.ask(socket, type="command", n=3, verb="save_map")  # hands over every tile
                assert (await client.next(socket, "answer"))["body"]["ok"]
                fetched = await asyncio.to_thread(subscriber.get, "map/tile/0/**?since=0")
                expected = {key: decode_grid(payload).cells for key, (_, payload) in fetched.items()}
                while not matches(expected):
                    shown.update(tiles_in(await client.next(socket, TILES)))

    def matches(expected: dict[str, np.ndarray]) -> bool:
        found = {f"map/tile/0/{ix}/{iy}": cells for (ix, iy), cells in shown.items()}
        return found.keys() == expected.keys() and all(
            np.array_equal(found[key], cells) for key, cells in expected.items()
        )

    asyncio.run(look())
    assert len(shown) > 5
    published = {pose.stamp_ns: pose for pose in map(decode_pose, (p for _, p in subscriber.heard["pose"]))}
    reported_twice = [pose for pose in poses if int(pose["stamp_ns"]) in published]
    assert len(reported_twice) > len(poses) // 2  # Zenoh drops poses that no one takes off its hands in time
    for pose in reported_twice:
        same = published[int(pose["stamp_ns"])].pose
        assert (pose["x_m"], pose["y_m"], pose["theta_rad"]) == (same.x_m, same.y_m, same.theta_rad)
