"""Stored sessions and maps for browsers: actions carried out beside the event loop, downloads by ticket.

A download is requested over the websocket, where the token counts; the answer names an address that works
once, so that the browser itself can fetch what may be gigabytes.
"""

import asyncio
import secrets
from collections.abc import Callable
from concurrent.futures import Executor
from functools import partial
from typing import Any

from aiohttp import web

from service.web.jobs import ResourceError
from service.web.protocol import ResourceRequest
from service.web.resources import Download, Resources

TICKET_S = 60.0
MAX_TICKETS = 16


class Downloads:
    """Lives in the event loop. resources: None where nothing is stored."""

    def __init__(self, resources: Resources | None) -> None:
        self._resources = resources
        self._tickets: dict[str, Download] = {}

    @property
    def stores(self) -> bool:
        """Whether there is anything to list."""
        return self._resources is not None

    def purge(self, workers: Executor) -> None:
        """Erase what was deleted before this run."""
        if self._resources is not None:
            workers.submit(self._resources.purge)

    def close(self) -> None:
        """End what is being made, and remove what was not fetched. The event loop has ended."""
        if self._resources is not None:
            self._resources.close()
        for ticket in list(self._tickets):
            self._withdraw(ticket)

    async def carry_out(self, requested: ResourceRequest, workers: Executor) -> dict[str, Any]:
        if self._resources is None:
            return {"ok": False, "error": "this service stores nothing"}
        work = self._work(self._resources, requested)
        try:
            return {"ok": True, **await asyncio.get_running_loop().run_in_executor(workers, work)}
        except ResourceError as error:
            return {"ok": False, "error": str(error)}

    async def hand_out(self, request: web.Request) -> web.StreamResponse:
        """The file of a ticket, once."""
        download = self._tickets.pop(request.match_info["ticket"], None)
        if download is None:
            raise web.HTTPNotFound(reason="this download was fetched already, or has waited too long")
        response = web.FileResponse(
            download.path, headers={"Content-Disposition": f'attachment; filename="{download.name}"'}
        )
        try:
            await response.prepare(request)
        finally:
            await asyncio.to_thread(download.clean_up)
        return response

    def _work(self, resources: Resources, requested: ResourceRequest) -> Callable[[], dict[str, Any]]:
        match requested.action:
            case "list":
                return resources.listing
            case "rename":
                return lambda: {"name": resources.rename(requested.kind, requested.name, requested.to)}
            case "delete":
                return lambda: {"undo": resources.delete(requested.kind, requested.name)}
            case "undo":
                return lambda: {"name": resources.undo(requested.to)}
            case "look":
                return lambda: resources.look(requested.name)
            case "keyframe":
                return lambda: resources.keyframe(requested.name, requested.request)
            case "download":
                loop = asyncio.get_running_loop()
                return partial(self._prepare, resources, requested, loop)

    def _prepare(
        self, resources: Resources, requested: ResourceRequest, loop: asyncio.AbstractEventLoop
    ) -> dict[str, Any]:
        download = resources.download(requested.kind, requested.name, requested.to)
        ticket = secrets.token_urlsafe(16)
        loop.call_soon_threadsafe(self._issue, ticket, download)
        return {"url": f"/download/{ticket}/{download.name}"}

    def _issue(self, ticket: str, download: Download) -> None:
        self._tickets[ticket] = download
        while len(self._tickets) > MAX_TICKETS:
            self._withdraw(next(iter(self._tickets)))
        asyncio.get_running_loop().call_later(TICKET_S, self._withdraw, ticket)

    def _withdraw(self, ticket: str) -> None:
        if (download := self._tickets.pop(ticket, None)) is not None:
            download.clean_up()
