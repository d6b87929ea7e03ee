"""One browser's websocket: messages to it, and its requests."""

import asyncio
import json
import logging
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Any

from aiohttp import WSCloseCode, WSMsgType, web

from service.allowance import Allowance
from service.web.protocol import (
    CommandRequest,
    RequestError,
    ResourceRequest,
    TokenShown,
    read_request,
    to_json,
)
from service.web.send_queue import SendQueue
from service.web.tile_stream import TileFeed
from service.web.tokens import Attempts, Grant, Tokens

log = logging.getLogger(__name__)

SEND_TIMEOUT_S = 10.0  # a browser that has not read for so long is disconnected; it reconnects by itself
CLOSE_TIMEOUT_S = 1.0
TILE_PERIOD_S = 0.5
MAX_WRONG_TOKENS = 5
SHOW_TOKEN_S = 5.0  # where the places without one are taken
MAX_COMMANDS = 4  # of one browser, being carried out
MAX_ASKED_PER_S = 20.0
ASKED_BURST = 40.0
LOOKS = ("list", "look", "keyframe")  # actions that change nothing, and are in no log
MAX_LOGGED = 300  # characters of a request and of its answer


@dataclass(frozen=True, slots=True)
class Gate:
    """Decides who may make changes."""

    tokens: Tokens
    attempts: Attempts


CarryOut = Callable[[CommandRequest | ResourceRequest], Awaitable[dict[str, Any]]]  # -> the answer's body


class Browser:
    """Sends from its queue, and tiles; reads tokens and commands. Lives in the event loop."""

    def __init__(
        self,
        socket: web.WebSocketResponse,
        address: str,
        gate: Gate,
        must_show: bool,
        feed: TileFeed,
        carry_out: CarryOut,
    ) -> None:
        self.send_queue = SendQueue()
        self.address = address
        self.must_show = must_show  # a token, soon
        self.grant: Grant | None = None  # what it has shown
        self.reads = True  # False: it has not taken what was sent for too long
        self._socket = socket
        self._gate = gate
        self._feed = feed
        self._carry_out = carry_out
        self._version = 0  # of the newest tile sent
        self._tiles_due_s = 0.0
        self._wrong_tokens = 0
        self._commands: set[asyncio.Task[None]] = set()
        self._requesting = Allowance(MAX_ASKED_PER_S, ASKED_BURST)

    @property
    def is_guest(self) -> bool:
        """Whether it has shown no token."""
        return self.grant is None

    @property
    def may_control(self) -> bool:
        return (
            self.grant is not None
            and self.grant.role == "operator"
            and self._gate.tokens.still_holds(self.grant)
        )

    def look_again(self) -> None:
        """Take the right away once the token is revoked or has expired."""
        if self.grant is not None and not self._gate.tokens.still_holds(self.grant):
            log.info("web: the token of %s, at %s, holds no more", self.grant.name, self.address)
            self.grant = None
            self._tell_access("the token was revoked, or has expired")

    async def serve(self) -> None:
        """Until it disconnects, or is disconnected."""
        sending = asyncio.create_task(self._send())
        reading = asyncio.create_task(self._read())
        waiting = [asyncio.create_task(self._leave_without_token())] if self.must_show else []
        try:
            await asyncio.wait((sending, reading), return_when=asyncio.FIRST_COMPLETED)
        finally:
            tasks = (sending, reading, *waiting, *self._commands)
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    async def let_go(self, code: WSCloseCode, words: str) -> None:
        """Close, without waiting for a browser that does not read."""
        try:
            async with asyncio.timeout(CLOSE_TIMEOUT_S):
                await self._socket.close(code=code, message=words.encode()[:120])
        except TimeoutError:
            self.reads = False

    async def _leave_without_token(self) -> None:
        await asyncio.sleep(SHOW_TOKEN_S)
        if self.is_guest:
            await self.let_go(WSCloseCode.TRY_AGAIN_LATER, "the places without a token are taken")

    async def _send(self) -> None:
        clock = asyncio.get_running_loop().time
        while True:
            await self.send_queue.filled.wait()
            for payload in self.send_queue.take():
                await self._put(payload)
            if clock() >= self._tiles_due_s and (batch := await self._feed.after(self._version)):
                await self._put(batch.payload)
                self._version = batch.version
                if batch.is_last:
                    self._tiles_due_s = clock() + TILE_PERIOD_S
                else:
                    self.send_queue.wake()  # the rest at once: poses go between the parts

    async def _put(self, payload: str | bytes) -> None:
        try:
            async with asyncio.timeout(SEND_TIMEOUT_S):
                if isinstance(payload, str):
                    await self._socket.send_str(payload)
                else:
                    await self._socket.send_bytes(payload)
        except TimeoutError:
            self.reads = False
            log.info("web: %s has not read for %.0f s; it is let go", self.address, SEND_TIMEOUT_S)
            raise

    async def _read(self) -> None:
        async for message in self._socket:
            if message.type is not WSMsgType.TEXT or not self._requesting.takes_one():
                await self.let_go(WSCloseCode.POLICY_VIOLATION, "more or other messages than are read")
                return
            try:
                requested = read_request(message.data)
            except RequestError as error:
                self.send_queue.answer(to_json("refused", error=str(error)))
                continue
            match requested:
                case TokenShown(token=token):
                    if not await self._look_at(token):
                        return
                case CommandRequest() | ResourceRequest():
                    self._begin(requested)

    async def _look_at(self, token: str) -> bool:
        """False where it has tried too often and is disconnected."""
        self.grant = self._gate.tokens.grant_of(token)
        if self.grant is not None:
            log.info("web: %s is %s, %s", self.address, self.grant.name, self.grant.role)
            self._tell_access()
            return True
        self._wrong_tokens += 1
        await asyncio.sleep(self._gate.attempts.wrong(self.address))
        self._tell_access("this is not the token of this service, or it has expired")
        if self._wrong_tokens < MAX_WRONG_TOKENS:
            return True
        await self.let_go(WSCloseCode.POLICY_VIOLATION, "too many wrong tokens")
        return False

    def _tell_access(self, error: str = "") -> None:
        name, role = (self.grant.name, self.grant.role) if self.grant is not None else ("", "")
        self.send_queue.answer(
            to_json("access", may_control=self.may_control, name=name, role=role, error=error)
        )

    def _begin(self, requested: CommandRequest | ResourceRequest) -> None:
        is_looking = isinstance(requested, ResourceRequest) and requested.action == "list"
        if not self.may_control and not is_looking:
            self._answer(
                requested.n, {"ok": False, "error": "this needs the token of an operator; you may only look"}
            )
        elif len(self._commands) >= MAX_COMMANDS:
            words = f"{MAX_COMMANDS} commands of this page are being carried out; wait for one to end"
            self._answer(requested.n, {"ok": False, "error": words})
        else:
            task = asyncio.create_task(self._command(requested))
            self._commands.add(task)
            task.add_done_callback(self._commands.discard)

    async def _command(self, requested: CommandRequest | ResourceRequest) -> None:
        by = "without a token" if self.grant is None else f"by {self.grant.name}"
        try:
            body = await self._carry_out(requested)
        except asyncio.CancelledError:  # a thread goes on with it
            self._log(requested, by, {"error": "the browser has gone before the answer"})
            raise
        self._log(requested, by, body)
        self._answer(requested.n, body)

    def _log(self, requested: CommandRequest | ResourceRequest, by: str, body: dict[str, Any]) -> None:
        if isinstance(requested, CommandRequest) or requested.action not in LOOKS:
            words = requested.model_dump(mode="json", exclude={"type", "n"}, exclude_defaults=True)
            log.info("web: %s at %s: %s: %s", by, self.address, _shown(words), _shown(body))

    def _answer(self, n: int, body: dict[str, Any]) -> None:
        self.send_queue.answer(to_json("answer", n=n, body=body))


def _shown(words: dict[str, Any]) -> str:
    """For the log: on one line, and cut where it is long."""
    text = json.dumps(words)
    return text if len(text) <= MAX_LOGGED else f"{text[:MAX_LOGGED]}..."
