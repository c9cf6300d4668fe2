"""Object library over HTTP: `GET /v1/objects` lists the objects, `GET /v1/objects/{name}` returns a file."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from fastapi import FastAPI, Request
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import JSONResponse, PlainTextResponse, Response

from server.service.edge.access import refused, shared_headers
from server.service.edge.authenticator import Authenticator
from server.service.routes.object_library import MEDIA_TYPES, NoObject, ObjectLibrary

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
    """Add the routes, with the same access rules as the stream. Files are read in threads."""

    @app.get(OBJECTS_PATH, responses=REFUSED)
    async def listing(request: Request) -> Response:
        if (refusal := await refused(authenticator, request)) is not None:
            return refusal
        listed = await run_in_threadpool(library.listing)
        return JSONResponse({"objects": [asdict(offered) for offered in listed]}, headers=shared_headers(request))

    @app.get(OBJECTS_PATH + "/{name}", response_class=Response, responses=REFUSED | FILES)
    async def one(request: Request, name: str) -> Response:
        if (refusal := await refused(authenticator, request)) is not None:
            return refusal
        try:
            found = await run_in_threadpool(library.read, name)
        except NoObject as error:
            return PlainTextResponse(f"{error}\n", status_code=404, headers=shared_headers(request))
        headers = shared_headers(request) | {"etag": found.etag}
        if found.etag in request.headers.get("if-none-match", ""):
            return Response(status_code=304, headers=headers)
        return Response(found.data, media_type=found.media_type, headers=headers)
