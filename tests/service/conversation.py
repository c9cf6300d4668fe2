"""Conversations of the Python client with a server."""

import asyncio
from collections.abc import Awaitable, Callable

from client.streaming.client import Answer, StreamClient
from protocol.messages import Dropped, Error
from tests.service.fakes import PATIENCE_S


def with_client(url: str, talk: Callable[[StreamClient], Awaitable], **options: object) -> object:
    """Run a conversation over a new connection, with a limit on its time."""

    async def run() -> object:
        client = await StreamClient.connect(url, **options)
        try:
            return await talk(client)
        finally:
            await client.close()

    return asyncio.run(asyncio.wait_for(run(), PATIENCE_S))


async def next_answer(client: StreamClient) -> Answer | Dropped | Error:
    return await anext(client.answers())
