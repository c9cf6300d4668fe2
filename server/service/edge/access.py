"""Access rules of files over HTTP: those of the stream."""

from __future__ import annotations

import logging

from fastapi import Request
from fastapi.responses import PlainTextResponse, Response

from server.service.edge.authenticator import Authenticator, address_of
from server.service.edge.connection import UNAUTHORIZED

log = logging.getLogger(__name__)


async def refused(authenticator: Authenticator, request: Request) -> Response | None:
    """The answer to a request without the token, or from a page of another origin; None if it is let in.

    A wrong token is answered late if there were many; the refusal is logged.
    """
    refusal = await authenticator.slowed_refusal(request)
    if refusal is None:
        return None
    extra = {"address": address_of(request), "path": request.url.path, "reason": refusal.reason}
    log.info("request refused", extra=extra)
    status = 401 if refusal.code == UNAUTHORIZED else 403
    return PlainTextResponse(f"{refusal.reason}\n", status_code=status, headers={"cache-control": "no-store"})


def shared_headers(request: Request, cached: str = "private, no-cache") -> dict[str, str]:
    """Headers of a file that pages of allowed origins may read; default: cacheable with revalidation."""
    headers = {"cache-control": cached, "vary": "origin", "x-content-type-options": "nosniff"}
    origin = request.headers.get("origin")
    return headers if origin is None else headers | {"access-control-allow-origin": origin}
