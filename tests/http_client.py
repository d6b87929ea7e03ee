"""Sessions of aiohttp that leave no connection behind."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import aiohttp


@asynccontextmanager
async def client_session(**settings: Any) -> AsyncIterator[aiohttp.ClientSession]:
    """Its connections are gone at its end. One that is only closed stays until what it has written is sent,
    for ever where the server has stopped to read, and the loop ends before.
    """
    loop, transports = asyncio.get_running_loop(), list[asyncio.WriteTransport]()
    connect = loop.create_connection

    async def create_connection(*arguments: Any, **more: Any) -> Any:
        transport, protocol = await connect(*arguments, **more)
        transports.append(transport)
        return transport, protocol

    loop.create_connection = create_connection  # type: ignore[method-assign]
    try:
        async with aiohttp.ClientSession(**settings) as session:
            yield session
    finally:
        for transport in transports:
            transport.abort()
        await asyncio.sleep(0)
