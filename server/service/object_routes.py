"""Object library over HTTP: `GET /v1/objects` lists the objects, `GET /v1/objects/{name}` returns a file."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from fastapi import FastAPI, Request
from fastapi.responses import JSONResponse, PlainTextResponse, Response

from server.service.authenticator import Authenticator
from server.service.connection import UNAUTHORIZED
from server.service.object_library import MEDIA_TYPES, NoObject, ObjectLibrary

OBJECTS_PATH = "/v1/objects"
_TEXT: dict[str, Any] = {"content": {"text/plain": {}}}
REFUSED: dict[int | str, dict[str, Any]] = {
    401: _TEXT | {"description": "The token is missing or wrong"},
    403: _TEXT | {"description": "A page of another origin"},
}
FILES: dict[int | str, dict[str, Any]] = {
    200: {"description": "The file", "content": {media: {} for media in sorted(set(MEDIA_TYPES.values()))}},
    304: {"description": "As it was"},
    404: _TEXT | {"description": "No such object"},
}


def add_objects(app: FastAPI, library: ObjectLibrary, authenticator: Authenticator) -> None:
    """Add the routes, with the same access rules as the stream. Handlers are synchronous, so they run in threads."""

    @app.get(OBJECTS_PATH, responses=REFUSED)
    def listing(request: Request) -> Response:
        return _refusal(authenticator, request) or JSONResponse(
            {"objects": [asdict(offered) for offered in library.listing()]}, headers=_headers(request)
        )

    @app.get(OBJECTS_PATH + "/{name}", response_class=Response, responses=REFUSED | FILES)
    def one(request: Request, name: str) -> Response:
        if (refusal := _refusal(authenticator, request)) is not None:
            return refusal
        try:
            found = library.read(name)
        except NoObject as error:
            return PlainTextResponse(f"{error}\n", status_code=404, headers=_headers(request))
        headers = _headers(request) | {"etag": found.etag}
        if found.etag in request.headers.get("if-none-match", ""):
            return Response(status_code=304, headers=headers)
        return Response(found.data, media_type=found.media_type, headers=headers)


def _refusal(authenticator: Authenticator, request: Request) -> Response | None:
    refusal = authenticator.refusal(request)
    if refusal is None:
        return None
    status = 401 if refusal.code == UNAUTHORIZED else 403
    return PlainTextResponse(f"{refusal.reason}\n", status_code=status, headers={"cache-control": "no-store"})


def _headers(request: Request) -> dict[str, str]:
    """Cacheable with revalidation; readable by pages of allowed origins."""
    headers = {"cache-control": "private, no-cache", "vary": "origin", "x-content-type-options": "nosniff"}
    origin = request.headers.get("origin")
    return headers if origin is None else headers | {"access-control-allow-origin": origin}
