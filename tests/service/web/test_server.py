"""The page's server: what it serves, to how many, and how it begins and ends."""

import asyncio
import re
import shutil
import socket as sockets
import ssl
import struct
import subprocess
import time

import aiohttp
import pytest

from service.encoding import encode_pose
from service.web import browser
from service.web.protocol import PATH, TILES
from tests.browser.scene import Scene
from tests.service.mapstore.tile_makers import tile
from tests.service.web.conftest import TIMEOUT_S, TOKEN, repeating, talk
from tests.waiting import wait_until

HANDSHAKE = (
    "GET /ws HTTP/1.1\r\nHost: {host}\r\nOrigin: {origin}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    "Sec-WebSocket-Key: MDEyMzQ1Njc4OWFiY2RlZg==\r\nSec-WebSocket-Version: 13\r\n\r\n"
)


def host_and_port(address: str) -> tuple[str, int]:
    host, _, port = address.partition("://")[2].rstrip("/").rpartition(":")
    return host, int(port)


def test_the_page_comes_with_strict_headers_and_files_that_a_browser_keeps(serve):
    async def look(client):
        async with client.session.get(client.address) as response:
            page = await response.text()
            assert response.headers["Content-Security-Policy"].startswith("default-src 'none'")
            assert response.headers["Cache-Control"] == "no-cache"
        assert "<canvas" in page
        assert "http" not in page.replace("http-equiv", "")
        (edition,) = set(re.findall(r'"([0-9a-f]{16})/[a-z_]+\.(?:js|css)"', page))
        for name in ("main.js", "page.css", "tiles.js"):
            assert f'"{edition}/{name}"' in page
            async with client.session.get(f"{client.address}{edition}/{name}") as packed:
                assert packed.headers["Content-Encoding"] == "gzip"
                assert "immutable" in packed.headers["Cache-Control"]
                assert packed.headers["X-Content-Type-Options"] == "nosniff"
                content = await packed.read()
            whole = {"Accept-Encoding": "identity"}
            async with client.session.get(f"{client.address}{edition}/{name}", headers=whole) as plain:
                assert "Content-Encoding" not in plain.headers
                assert await plain.read() == content
            async with client.session.get(f"{client.address}{name}") as unversioned:
                tag = {"If-None-Match": unversioned.headers["ETag"]}
            async with client.session.get(f"{client.address}{name}", headers=tag) as again:
                assert again.status == 304
        async with client.session.get(f"{client.address}{edition[::-1]}/main.js") as gone:
            assert (gone.status, gone.headers["Cache-Control"]) == (404, "no-cache")

    talk(serve(), look)


@pytest.mark.parametrize(
    "path", ["server.py", "../server.py", "%2e%2e/server.py", "static/main.js", "main.js/", "//etc/passwd"]
)
def test_nothing_else_can_be_fetched(serve, path):
    async def look(client):
        async with client.session.get(f"{client.address}{path}") as response:
            assert response.status == 404
            assert response.headers["Content-Security-Policy"]

    talk(serve(), look)


def test_changed_tiles_follow_and_a_reset_empties_map_and_path(serve, store):
    server = serve()
    store.update([tile(0, 0, 1)])

    async def look(client):
        server.put(encode_pose(Scene().output(0.0), 1))
        async with client.socket() as socket:
            await client.next(socket, TILES)
            store.update([tile(5, -5, 2)])
            payload = await client.next(socket, TILES)
            assert struct.unpack_from("<I", payload, 8) == (1,)
            store.start_over()
            paths = [await client.next(socket, PATH)]
            while struct.unpack_from("<I", paths[-1], 4) != (0,):
                paths.append(await client.next(socket, PATH))
            assert struct.unpack_from("<I", await client.next(socket, TILES), 8) == (2,)

    talk(server, look)


def test_a_command_that_takes_long_holds_up_neither_poses_nor_others(serve, dispatcher):
    server = serve()

    async def ask(client):
        async with client.socket() as socket:
            await client.ask(socket, type="token", token=TOKEN)
            for n in range(browser.MAX_COMMANDS + 1):
                await client.ask(socket, type="command", n=n, verb="wait")
            too_many = await client.next(socket, "answer")
            assert too_many["n"] == browser.MAX_COMMANDS
            assert "wait for one to end" in too_many["body"]["error"]
            server.put(encode_pose(Scene().output(0.0), 1))
            await client.next(socket, "pose")
            dispatcher.go_on.set()
            answered = [(await client.next(socket, "answer"))["n"] for _ in range(browser.MAX_COMMANDS)]
            assert sorted(answered) == list(range(browser.MAX_COMMANDS))

    talk(server, ask)


def test_a_command_whose_browser_goes_before_the_answer_is_in_the_log(serve, dispatcher, caplog):
    """It is carried out all the same."""
    caplog.set_level("INFO")
    server = serve()

    async def ask(client):
        async with client.socket() as socket:
            await client.ask(socket, type="token", token=TOKEN)
            await client.ask(socket, type="command", n=1, verb="wait")
            wait_until(lambda: dispatcher.requested)
        wait_until(lambda: "the browser has gone before the answer" in caplog.text)

    talk(server, ask)
    assert '{"verb": "wait"}' in caplog.text


def test_stored_things_are_listed_for_all_and_handed_out_once_for_the_token(serve, tmp_path):
    (tmp_path / "a.mcap").write_bytes(b"a session")

    async def ask(client):
        async with client.socket() as socket:
            await client.ask(socket, type="resource", n=1, action="list")
            listed = (await client.next(socket, "answer"))["body"]
            assert [entry["name"] for entry in listed["session"]] == ["a.mcap"]
            changing = ("download", "delete", "rename", "undo", "look", "keyframe")
            for n, action in enumerate(changing, start=2):
                await client.ask(socket, type="resource", n=n, action=action, name="a.mcap", to="mcap")
                assert "token" in (await client.next(socket, "answer"))["body"]["error"]
            await client.ask(socket, type="token", token=TOKEN)
            await client.ask(socket, type="resource", n=19, action="download", name="a.mcap", to="mcap")
            url = (await client.next(socket, "answer"))["body"]["url"]
            for status in (200, 404):  # a ticket is good for once
                async with client.session.get(client.address.rstrip("/") + url) as response:
                    assert response.status == status
                    content = await response.read()
                    if status == 200:
                        assert content == b"a session"
                        assert response.headers["Content-Disposition"] == 'attachment; filename="a.mcap"'
                        assert response.headers["X-Content-Type-Options"] == "nosniff"
            await client.ask(socket, type="resource", n=20, action="delete", name="a.mcap")
            number = (await client.next(socket, "answer"))["body"]["undo"]
            assert not (tmp_path / "a.mcap").exists()
            await client.ask(socket, type="resource", n=11, action="undo", to=number)
            assert (await client.next(socket, "answer"))["body"] == {"ok": True, "name": "a.mcap"}
            assert (tmp_path / "a.mcap").exists()

    talk(serve(folders={"session": tmp_path, "map": tmp_path}), ask)


def test_a_browser_that_never_reads_slows_nothing_and_is_let_go(serve, store, monkeypatch, caplog):
    caplog.set_level("INFO")
    monkeypatch.setattr(browser, "SEND_TIMEOUT_S", 1.0)
    monkeypatch.setattr(browser, "TILE_PERIOD_S", 0.0)
    server = serve()
    scene = Scene()
    took_ns: list[int] = []
    version = 0

    def put() -> None:
        """Poses, and as much new map as fills every buffer in between soon."""
        nonlocal version
        tiles = [tile(ix, 0, version + ix + 1, edge=256) for ix in range(8)]
        version += 8
        store.update(tiles)
        messages = scene.messages(version / 100)
        before_ns = time.thread_time_ns()  # not the clock's: the machine may be busy
        for message in messages:
            server.put(message)
        took_ns.append(time.thread_time_ns() - before_ns)

    host, port = host_and_port(server.address)
    with sockets.create_connection((host, port), TIMEOUT_S) as silent:
        silent.setsockopt(sockets.SOL_SOCKET, sockets.SO_RCVBUF, 4096)
        silent.sendall(HANDSHAKE.format(origin=server.address.rstrip("/"), host=f"{host}:{port}").encode())

        async def look(client):
            async with client.socket() as socket:
                while server.health().values["browsers"] != "2":
                    await client.next(socket, "pose")
                while server.health().values["browsers"] != "1":  # the silent one is let go
                    await client.next(socket, "pose")

        with repeating(put):
            talk(server, look)
    assert "has not read for 1 s" in caplog.text
    assert int(server.health().values["dropped"]) > 0
    assert sorted(took_ns)[len(took_ns) // 2] < 500_000  # five messages; it only queues


def test_a_port_that_is_taken_is_reported_and_taken_when_it_is_free(serve):
    with sockets.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        server = serve(wait=False, listen=f"127.0.0.1:{port}")
        wait_until(lambda: "cannot be served" in server.health().message)
        assert server.health().level == 2
        assert server.health().values["reason_id"] == "not_served"
        assert server.address == ""
    assert server.wait_served(TIMEOUT_S)
    assert server.address == f"http://127.0.0.1:{port}/"
    assert (server.health().level, server.health().message) == (0, "ok")


def test_close_lets_browsers_and_port_go(serve):
    server = serve()
    ended: list[int | None] = []

    async def look(client):
        async with client.socket() as socket:
            await client.next(socket, "hello")
            code, _ = await asyncio.gather(client.closed_with(socket), asyncio.to_thread(server.close))
            ended.append(code)

    address = server.address
    talk(server, look)
    server.close()
    assert ended == [aiohttp.WSCloseCode.GOING_AWAY]
    assert server.health().message == "stopped"
    with pytest.raises(ConnectionRefusedError):
        sockets.create_connection(host_and_port(address), 1.0)


def test_a_certificate_makes_it_https(serve, tmp_path):
    key, certificate = tmp_path / "key.pem", tmp_path / "certificate.pem"
    command = "openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -nodes -days 1"
    command += f" -subj /CN=localhost -addext subjectAltName=IP:127.0.0.1 -keyout {key} -out {certificate}"
    if shutil.which("openssl") is None:
        pytest.skip("no openssl; on Debian and Ubuntu: apt install openssl")
    subprocess.run(command.split(), check=True)
    server = serve(tls_certificate=certificate, tls_key=key)
    assert server.address.startswith("https://")

    trust = ssl.create_default_context(cafile=str(certificate))

    async def look(client):
        async with client.socket(ssl=trust) as socket:
            assert (await client.next(socket, "hello"))["verbs"]

    talk(server, look)
