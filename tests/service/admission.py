"""Whether a client with a token is let in."""

import asyncio

import pytest

from client.streaming.client import Access, ClientError, StreamClient
from tests.service.fakes import CAMERA, PATIENCE_S

TOKEN = "a+b/c=d&e?f%20"  # what a URL must quote


def connected(url: str, access: Access | None = None) -> str:
    """The device of a server that lets a client in."""

    async def run() -> str:
        client = await StreamClient.connect(url, access=access)
        try:
            return (await client.hello(CAMERA)).device
        finally:
            await client.close()

    return asyncio.run(asyncio.wait_for(run(), PATIENCE_S))


def not_connected(url: str, access: Access | None = None) -> str:
    """The line of a client that is not let in; it must not give away what it knocked with."""
    with pytest.raises(ClientError) as error:
        connected(url, access)
    assert "\n" not in str(error.value)
    assert TOKEN not in str(error.value)
    return str(error.value)
