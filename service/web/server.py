"""Serves the operator's page from a thread with its own event loop; no driver and no mapper waits for it.

    any thread --put--> LiveView --twenty times a second--> a SendQueue a browser --> its websocket
                        TileStore --TileFeed, when the browser has taken what came before--'

A page that cannot be served is reported in health and tried again; mapping goes on without it.
"""

import asyncio
import contextlib
import gzip
import hashlib
import json
import logging
import ssl
import threading
import time
import uuid
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from importlib.resources import files as package_files
from pathlib import Path
from typing import Any, Protocol

from aiohttp import WSCloseCode, web

from drivers.frames import CAUSES
from service.encoding import ERROR, OK, WARNING, Status
from service.errors import StorageError, words_of
from service.outputs import reason_value
from service.version import VERSION
from service.web.access import HEADERS, host_fault, origin_fault, own_names
from service.web.browser import Browser, Gate
from service.web.config import WebConfig, split_listen
from service.web.connections import Listener, Seats
from service.web.downloads import Downloads
from service.web.help import Manual
from service.web.live_view import LiveView, Shown
from service.web.protocol import LARGEST_ASKED, CommandRequest, ResourceRequest, to_json
from service.web.resources import Kind, Resources
from service.web.tile_stream import MapSource, TileFeed
from service.web.tokens import Attempts, Tokens

log = logging.getLogger(__name__)

SHOW_PERIOD_S = 0.05
IDLE_PERIOD_S = 0.25  # no browser is connected: only the path is kept
RETRY_S = 5.0
SERVED_WITHIN_S = 5.0
HEARTBEAT_S = 20.0
CLOSE_TIMEOUT_S = 5.0
LASTING = "public, max-age=31536000, immutable"  # a year
COMMAND_THREADS = 4
WRITE_BUFFER = 262_144  # bytes that wait in the process for a browser that does not read
NO_PLACE = WSCloseCode.TRY_AGAIN_LATER, "the places without a token are taken"

_TYPES = {
    "html": "text/html; charset=utf-8",
    "css": "text/css; charset=utf-8",
    "js": "text/javascript; charset=utf-8",
    "svg": "image/svg+xml",
    "webmanifest": "application/manifest+json",
}


class CommandAnswer(Protocol):
    """Result of a command."""

    @property
    def body(self) -> bytes: ...


@dataclass(frozen=True, slots=True)
class About:
    """Facts on the service that the page shows."""

    vehicle: str
    profile: str
    verbs: Callable[[], Sequence[str]]  # commands that the service knows
    profiles: Sequence[str] = ()  # that it can be switched to, with switch_profile


class WebServer:
    """The page, from `start` to `close`. `put...`, as of LiveView, and `health` from any thread.

    tiles     the store of the map
    answer    carries out a command: verb, JSON -> JSON; may wait, in bounded time
    token     who shows it may give commands
    granted   file of further tokens, see tokens.py; None: there are none
    folders   where sessions and maps are stored; None: the page shows none
    retry_s   until a place to serve at is tried again; None: one try is all, and health gives the reason
    """

    def __init__(
        self,
        config: WebConfig,
        about: About,
        tiles: MapSource,
        answer: Callable[[str, bytes], CommandAnswer],
        token: str,
        folders: Mapping[Kind, Path] | None = None,
        retry_s: float | None = RETRY_S,
        granted: Path | None = None,
    ) -> None:
        self._config = config
        self._about = about
        self._tiles = tiles
        self._answer = answer
        self._gate = Gate(Tokens(token, granted), Attempts())
        self._seats = Seats(config.most_browsers)
        self._retry_s = retry_s
        self._names = own_names(config.hosts)
        self._scheme = "https" if config.tls_certificate else "http"
        self._view = view = LiveView(time.monotonic_ns)
        self.put, self.put_path, self.put_stretch, self.put_ready = (
            view.put, view.put_path, view.put_stretch, view.put_ready
        )  # fmt: skip
        self._run_id = uuid.uuid4().hex  # another one: the service was started again
        self._edition, self._files = _static_files()
        self._packed: dict[str, bytes] = {}  # by name, once it has been requested
        self._manual = Manual()
        self._downloads = Downloads(
            Resources(folders, lambda: view.map_folders, folders["session"] / ".exports") if folders else None
        )
        self._browsers: dict[Browser, None] = {}  # the oldest first
        self._workers = ThreadPoolExecutor(COMMAND_THREADS, thread_name_prefix="web-command")
        self._map_number = tiles.number
        self._verbs = list(about.verbs())
        self._leaving: set[asyncio.Task[None]] = set()
        self._dropped = self._refused = 0
        self._listener = Listener(config.most_browsers, self._refuse)
        self._fault = "not started"
        self._has_failed = False
        self._address = ""
        self._changed = threading.Condition()  # of _address and _fault; and guards _ending and _is_closed
        self._loop: asyncio.AbstractEventLoop | None = None
        self._ending: asyncio.Event | None = None
        self._listening: asyncio.Server | None = None
        self._is_closed = False
        self._thread = threading.Thread(target=self._run, name="web-serve", daemon=True)

    @property
    def address(self) -> str:
        """Address of the page such as http://127.0.0.1:8080/, "" while it is not served."""
        return self._address

    def start(self) -> None:
        self._thread.start()

    def wait_served(self, timeout_s: float) -> bool:
        """Whether the page is up, at the latest after `timeout_s`, or when a single try has failed."""
        with self._changed:
            self._changed.wait_for(
                lambda: self._address or (self._has_failed and not self._retry_s), timeout_s
            )
            return bool(self._address)

    def health(self) -> Status:
        values = {
            "address": self._address,
            "browsers": str(len(self._browsers)),
            "dropped": str(self._dropped + sum(b.send_queue.dropped for b in list(self._browsers))),
            "refused": str(self._refused),
        }
        if fault := self._fault:
            return Status("web", ERROR, fault, values | reason_value("not_served"))
        if fault := self._gate.tokens.fault:
            words = f"further tokens are refused: {fault}"
            return Status("web", WARNING, words, values | reason_value("token_unreadable"))
        return Status("web", OK, "ok", values)

    def close(self) -> None:
        """Disconnect the browsers and close the port. A second call does nothing."""
        with self._changed:
            self._is_closed = True  # for a thread that has not come as far as to listen for the end
            loop, ending = self._loop, self._ending
        if loop is not None and ending is not None:
            with contextlib.suppress(RuntimeError):  # the loop has ended by itself
                loop.call_soon_threadsafe(ending.set)
        if self._thread.is_alive():
            self._thread.join(CLOSE_TIMEOUT_S)
            if self._thread.is_alive():
                log.error("web: still serving after %.0f s; the page is left behind", CLOSE_TIMEOUT_S)
        self._downloads.close()
        self._workers.shutdown(wait=False, cancel_futures=True)

    def _run(self) -> None:
        asyncio.run(self._serve())

    async def _serve(self) -> None:
        with self._changed:
            self._loop, self._ending = asyncio.get_running_loop(), asyncio.Event()
            if self._is_closed:
                return
        self._feed = TileFeed(self._tiles)
        runner = self._listener.runner(self._app())
        await runner.setup()
        showing = asyncio.create_task(self._show())
        self._downloads.purge(self._workers)
        try:
            while not await self._listen(runner):
                if await self._ends_within(self._retry_s, showing):
                    return
            await self._ends_within(None, showing)
        finally:
            self._say("", "stopped")
            if self._listening is not None:
                self._listening.close()
            showing.cancel()
            goodbye = [b.let_go(WSCloseCode.GOING_AWAY, "the service stops") for b in self._browsers]
            await asyncio.gather(showing, *goodbye, return_exceptions=True)
            await runner.cleanup()

    async def _listen(self, runner: web.AppRunner) -> bool:
        host, port = split_listen(self._config.listen)
        try:
            self._listening = await self._listener.open(runner, host, port, self._tls())
        except (OSError, ssl.SSLError) as error:
            words = f"the page cannot be served at {self._config.listen}: {words_of(error)}"
            if words != self._fault and self._retry_s is not None:
                log.error("web: %s; tried again each %.0f s, mapping goes on", words, self._retry_s)
            self._has_failed = True
            self._say("", words)
            return False
        bound_port = self._listening.sockets[0].getsockname()[1]
        shown_host = f"[{host}]" if ":" in host else host
        self._say(f"{self._scheme}://{shown_host}:{bound_port}/", "")
        return True

    async def _ends_within(self, timeout_s: float | None, showing: asyncio.Task[None]) -> bool:
        """Whether the page is to end; None: wait until it is. Raises what `showing` raised."""
        assert self._ending is not None
        ending = asyncio.create_task(self._ending.wait())
        await asyncio.wait((ending, showing), timeout=timeout_s, return_when=asyncio.FIRST_COMPLETED)
        ending.cancel()
        if showing.done():
            showing.result()  # the thread ends by it, which the fan-out reports
        return self._ending.is_set()

    def _refuse(self) -> None:
        self._refused += 1

    def _say(self, address: str, fault: str) -> None:
        with self._changed:
            self._address, self._fault = address, fault
            self._changed.notify_all()

    def _tls(self) -> ssl.SSLContext | None:
        if self._config.tls_certificate is None:
            return None
        context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
        context.load_cert_chain(self._config.tls_certificate, self._config.tls_key)
        return context

    def _app(self) -> web.Application:
        app = web.Application(middlewares=[self._guard], client_max_size=LARGEST_ASKED)
        app.on_response_prepare.append(_add_headers)
        app.router.add_get("/", partial(self._file, "index.html"))
        for name in self._files:
            app.router.add_get(f"/{name}", partial(self._file, name))
            app.router.add_get(f"/{self._edition}/{name}", partial(self._lasting_file, name))
        self._manual.add_to(app)
        app.router.add_get("/ws", self._websocket)
        app.router.add_get("/download/{ticket}/{name}", self._downloads.hand_out)
        return app

    @web.middleware
    async def _guard(self, request: web.Request, handler: Any) -> web.StreamResponse:
        """Host and Origin first, for every request."""
        fault = host_fault(request.host, self._names) or origin_fault(
            request.headers.get("Origin"), request.host, self._scheme
        )
        if fault:
            self._refuse()
            return web.Response(status=403, text=f"{fault}\n")
        response: web.StreamResponse = await handler(request)
        return response

    async def _file(self, name: str, request: web.Request) -> web.Response:
        content, content_type, tag = self._files[name]
        if request.headers.get("If-None-Match") == tag:
            return web.Response(status=304, headers={"ETag": tag})
        return web.Response(body=content, headers={"Content-Type": content_type, "ETag": tag})

    async def _lasting_file(self, name: str, request: web.Request) -> web.Response:
        """By an address that no other content will have: a browser that has it requests it no more."""
        content, content_type, _ = self._files[name]
        headers = {"Content-Type": content_type, "Cache-Control": LASTING, "Vary": "Accept-Encoding"}
        if "gzip" in request.headers.get("Accept-Encoding", ""):
            headers["Content-Encoding"] = "gzip"
            content = self._packed.setdefault(name, gzip.compress(content, mtime=0))
        return web.Response(body=content, headers=headers)

    async def _websocket(self, request: web.Request) -> web.StreamResponse:
        if not self._seats.has_place(self._browsers):
            self._refuse()
            leaving = self._seats.to_leave(self._browsers)
            if leaving is None:
                return web.Response(status=503, text=f"{len(self._browsers)} browsers look already\n")
            del self._browsers[leaving]
            self._leaving.add(goodbye := asyncio.create_task(leaving.let_go(*NO_PLACE)))
            goodbye.add_done_callback(self._leaving.discard)
        address = str(request.remote)
        must_show = self._seats.must_show(self._browsers, address)
        socket = web.WebSocketResponse(
            heartbeat=HEARTBEAT_S, max_msg_size=LARGEST_ASKED, compress=False, writer_limit=WRITE_BUFFER
        )
        await socket.prepare(request)
        browser = Browser(socket, address, self._gate, must_show, self._feed, self._carry_out)
        browser.send_queue.answer(self._hello())
        for shown in self._view.snapshot():
            _post(browser, shown)
        self._browsers[browser] = None
        self._listener.lasting.add(request.protocol)
        try:
            await browser.serve()
        finally:
            self._browsers.pop(browser, None)
            self._listener.lasting.discard(request.protocol)
            self._dropped += browser.send_queue.dropped
            if request.transport is not None and not browser.reads:
                request.transport.abort()  # what waits for it would stay for minutes
        return socket

    def _hello(self) -> str:
        return to_json(
            "hello",
            run_id=self._run_id,
            version=VERSION,
            vehicle=self._about.vehicle,
            profile=self._about.profile,
            profiles=list(self._about.profiles),
            verbs=self._verbs,
            stores=self._downloads.stores,
            causes=[cause.replace("_", " ") for cause in CAUSES],
            now_s=time.time(),
        )

    async def _show(self) -> None:
        """Hand out what is due, until cancelled."""
        while True:
            for shown in self._due():
                for browser in self._browsers:
                    _post(browser, shown)
            for browser in self._browsers:
                browser.look_again()
                browser.send_queue.wake()  # tiles may be due
            # the rate at which a picture changes, not a wait for an event
            await asyncio.sleep(SHOW_PERIOD_S if self._browsers else IDLE_PERIOD_S)

    def _due(self) -> list[Shown]:
        shown = self._view.due()
        verbs = list(self._about.verbs())
        if verbs != self._verbs:
            self._verbs = verbs
            shown.append(Shown("verbs", to_json("verbs", verbs=verbs)))
        if self._tiles.number != self._map_number:
            self._map_number = self._tiles.number
            shown += self._view.map_reset()
        return shown

    async def _carry_out(self, requested: CommandRequest | ResourceRequest) -> dict[str, Any]:
        if isinstance(requested, ResourceRequest):
            return await self._downloads.carry_out(requested, self._workers)
        loop = asyncio.get_running_loop()
        request = json.dumps(requested.request).encode()
        answer = await loop.run_in_executor(self._workers, self._answer, requested.verb, request)
        body: dict[str, Any] = json.loads(answer.body)
        return body


def start_serving(server: WebServer) -> None:
    """Raises StorageError where the page cannot be served; the server is closed then."""
    server.start()
    if not server.wait_served(SERVED_WITHIN_S):
        words = server.health().message
        server.close()
        raise StorageError(f"{words}; give another address with --listen, 127.0.0.1:0 takes any free port")


async def _add_headers(request: web.Request, response: web.StreamResponse) -> None:
    """To every response, refusals and downloads too."""
    for name, value in HEADERS.items():
        response.headers.setdefault(name, value)


def _post(browser: Browser, shown: Shown) -> None:
    if shown.key:
        browser.send_queue.put(shown.key, shown.payload)
    else:
        browser.send_queue.note(shown.payload)


def _static_files() -> tuple[str, Mapping[str, tuple[bytes, str, str]]]:
    """Name of their edition, another one for other content; and by name: content, type, tag. Read once;
    nothing else of the disk can be requested.
    """
    files = {}
    for file in package_files("service.web").joinpath("static").iterdir():
        kind = file.name.rpartition(".")[2]
        if kind in _TYPES:
            files[file.name] = file.read_bytes()
    edition = hashlib.sha256(b"".join(files[name] for name in sorted(files))).hexdigest()[:16]
    modules = sorted(name for name in files if name.endswith(".js") and name != "help.js")
    links = "".join(f'  <link rel="modulepreload" href="{name}">\n' for name in modules)  # all at once
    page = files["index.html"].decode().replace("</head>", f"{links}</head>")
    for name in (*modules, "page.css"):
        page = page.replace(f'"{name}"', f'"{edition}/{name}"')
    files["index.html"] = page.encode()
    return edition, {
        name: (content, _TYPES[name.rpartition(".")[2]], f'"{hashlib.sha256(content).hexdigest()[:16]}"')
        for name, content in files.items()
    }
