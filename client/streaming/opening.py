"""Opening the WebSocket; every failure is one line that says what to do."""

from __future__ import annotations

import ssl

from websockets.asyncio.client import ClientConnection
from websockets.asyncio.client import connect as open_socket
from websockets.exceptions import InvalidHandshake, InvalidURI
from websockets.typing import Subprotocol

from client.streaming.access import Access, AccessError, ConnectionParameters, connection_parameters, without_query
from protocol.limits import MAX_MESSAGE_BYTES, SUBPROTOCOL

OPEN_PATIENCE_S = 10.0
PING_S, PING_PATIENCE_S = 5.0, 15.0
"""A stalled connection is closed after the sum of both."""


class ClientError(Exception):
    """The server is absent, refuses, or has disconnected; one line that says which and what to do."""


async def open_client_socket(server_url: str, access: Access) -> ClientConnection:
    """An open socket with this version of the protocol. Raises ClientError."""
    shown = without_query(server_url)
    try:
        socket = await _connect(connection_parameters(server_url, access))
    except AccessError as error:
        raise ClientError(str(error)) from error
    except ssl.SSLCertVerificationError as error:  # before ValueError, its base class
        raise ClientError(_certificate_message(shown, access, error)) from error
    except (InvalidURI, ValueError) as error:
        raise ClientError(f"{shown} is no server address: give http://HOST:PORT") from error
    except InvalidHandshake as error:
        raise ClientError(
            f"what answers at {shown} is no probeless server ({error}); one with --tls has an https:// address"
        ) from error
    except ssl.SSLError as error:
        raise ClientError(
            f"what answers at {shown} does not speak TLS ({error.reason}): give http://HOST:PORT"
        ) from error
    except (OSError, TimeoutError) as error:
        why = str(error) or "no answer"
        raise ClientError(f"no server at {shown} ({why}): start one with: probeless serve") from error
    if socket.subprotocol != SUBPROTOCOL:
        await socket.close()
        raise ClientError(f"what answers at {shown} does not speak {SUBPROTOCOL}: use the same version on both")
    return socket


async def _connect(parameters: ConnectionParameters) -> ClientConnection:
    return await open_socket(
        parameters.stream_url,
        additional_headers=parameters.headers,
        subprotocols=[Subprotocol(SUBPROTOCOL)],
        compression=None,
        max_size=MAX_MESSAGE_BYTES,
        open_timeout=OPEN_PATIENCE_S,
        proxy=None,
        ssl=parameters.tls,
        ping_interval=PING_S,
        ping_timeout=PING_PATIENCE_S,
    )


def _certificate_message(shown: str, access: Access, error: ssl.SSLCertVerificationError) -> str:
    """Error message for a certificate that cannot be verified."""
    why = getattr(error, "verify_message", "") or str(error.args[-1])
    if access.tls_fingerprint is not None:
        return f"the certificate of {shown} is not the one of --tls-fingerprint ({why}): another server answers there"
    advice = "give --tls-fingerprint, which the server prints, or --tls-ca FILE"
    return f"the certificate of {shown} is not trusted ({why}): {advice}"
