"""A page that is always closed again, and a browser without a window."""

import asyncio
import json
import threading
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import aiohttp
import pytest

from service.mapstore.tiles import TileStore
from service.publishing.commands import Answer
from service.web.config import WebConfig
from service.web.server import About, WebServer
from tests.http_client import client_session
from tests.in_background import in_background

TOKEN = "the token of the test"
TIMEOUT_S = 20.0


@dataclass
class FakeDispatcher:
    """Answers commands, and holds one back until it is asked to go on."""

    requested: list[tuple[str, bytes]] = field(default_factory=list)
    go_on: threading.Event = field(default_factory=threading.Event)
    faults: dict[str, str] = field(default_factory=dict)  # by verb

    def answer(self, verb: str, payload: bytes) -> Answer:
        self.requested.append((verb, payload))
        if verb == "wait":
            assert self.go_on.wait(TIMEOUT_S)
        if fault := self.faults.get(verb):
            return Answer(False, json.dumps({"ok": False, "error": fault}).encode())
        return Answer(True, json.dumps({"ok": True, "verb": verb}).encode())


@pytest.fixture
def store() -> TileStore:
    return TileStore()


@pytest.fixture
def dispatcher() -> Iterator[FakeDispatcher]:
    made = FakeDispatcher()
    yield made
    made.go_on.set()


@contextmanager
def served(store: TileStore, answer: Callable[[str, bytes], Answer]) -> Iterator[Callable[..., WebServer]]:
    """Starts pages, by default at any free port of this machine, and closes them at the end."""
    opened: list[WebServer] = []

    def start(
        wait: bool = True,
        retry_s: float = 0.05,
        folders: dict[Any, Path] | None = None,
        granted: Path | None = None,
        **settings: Any,
    ) -> WebServer:
        config = WebConfig(**{"listen": "127.0.0.1:0", **settings})
        about = About("veh1", "corridor", lambda: ["mark", "wait"], ("corridor", "contour_lm", "imle"))
        opened.append(WebServer(config, about, store, answer, TOKEN, folders, retry_s, granted))
        opened[-1].start()
        assert not wait or opened[-1].wait_served(TIMEOUT_S)
        return opened[-1]

    try:
        yield start
    finally:
        for server in opened:
            server.close()


@pytest.fixture
def serve(store: TileStore, dispatcher: FakeDispatcher) -> Iterator[Callable[..., WebServer]]:
    with served(store, dispatcher.answer) as start:
        yield start


class Client:
    """A program that speaks as the page does."""

    def __init__(self, session: aiohttp.ClientSession, address: str) -> None:
        self.session = session
        self.address = address
        self._passed_over: dict[Any, list[tuple[str | int, Any]]] = {}  # by socket

    def socket(self, **settings: Any) -> Any:
        return self.session.ws_connect(f"{self.address}ws", max_msg_size=0, **settings)

    async def next(self, socket: aiohttp.ClientWebSocketResponse, kind: str | int) -> Any:
        """The next message of a type, or of a binary kind; those before it wait to be asked for."""
        waiting = self._passed_over.setdefault(socket, [])
        for k, (kind_of, content) in enumerate(waiting):
            if kind_of == kind:
                del waiting[k]
                return content
        async with asyncio.timeout(TIMEOUT_S):
            while True:
                kind_of, content = _read(await socket.receive())
                if kind_of == kind:
                    return content
                waiting.append((kind_of, content))

    async def ask(self, socket: aiohttp.ClientWebSocketResponse, **message: Any) -> None:
        await socket.send_str(json.dumps(message))

    async def closed_with(self, socket: aiohttp.ClientWebSocketResponse) -> int | None:
        """The close code, whatever still comes before."""
        async with asyncio.timeout(TIMEOUT_S):
            while not socket.closed:
                await socket.receive()
        return socket.close_code


def _read(message: aiohttp.WSMessage) -> tuple[str | int, Any]:
    """Type and content of a text, kind and bytes of a binary message."""
    if message.type is aiohttp.WSMsgType.TEXT:
        content = json.loads(message.data)
        return content["type"], content
    assert message.type is aiohttp.WSMsgType.BINARY, f"closed meanwhile: {message}"
    return message.data[0], message.data


class Addressed(Protocol):
    """Anything that serves the page."""

    @property
    def address(self) -> str: ...


def talk(server: Addressed, conversation: Callable[[Client], Awaitable[None]]) -> None:
    """Hold it, and close what was opened."""

    async def hold() -> None:
        async with client_session() as session:
            await conversation(Client(session, server.address.partition("#")[0]))

    asyncio.run(hold())


@contextmanager
def repeating(action: Callable[[], None], period_s: float = 0.01) -> Iterator[None]:
    """Does it again and again in a thread of its own."""

    def repeat(ended: threading.Event) -> None:
        while not ended.wait(period_s):
            action()

    with in_background(repeat):
        yield
