"""Access rules of files over HTTP: those of the stream."""

from __future__ import annotations

from fastapi import Request
from fastapi.responses import PlainTextResponse, Response

from server.service.authenticator import Authenticator
from server.service.connection import UNAUTHORIZED


def refused(authenticator: Authenticator, request: Request) -> Response | None:
    """The answer to a request without the token, or from a page of another origin; None if it is let in."""
    refusal = authenticator.refusal(request)
    if refusal is None:
        return None
    status = 401 if refusal.code == UNAUTHORIZED else 403
    return PlainTextResponse(f"{refusal.reason}\n", status_code=status, headers={"cache-control": "no-store"})


def shared_headers(request: Request, cached: str = "private, no-cache") -> dict[str, str]:
    """Headers of a file that pages of allowed origins may read; default: cacheable with revalidation."""
    headers = {"cache-control": cached, "vary": "origin", "x-content-type-options": "nosniff"}
    origin = request.headers.get("origin")
    return headers if origin is None else headers | {"access-control-allow-origin": origin}
