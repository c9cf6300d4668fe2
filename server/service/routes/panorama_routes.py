"""The light at a place over HTTP, as a lat-long picture: `GET /v1/panorama.hdr` and `/v1/panorama.exr`."""

from __future__ import annotations

import math
from typing import Annotated, Any

from fastapi import FastAPI, Query, Request
from fastapi.responses import PlainTextResponse, Response

from protocol.codec import one_line
from protocol.messages import PanoramaFormat, Vector3
from server.service.edge.access import refused, shared_headers
from server.service.edge.authenticator import Authenticator
from server.service.mailbox import PanoramaOrder
from server.service.routes.object_routes import REFUSED
from server.service.service import NoSession, Service

PANORAMA_PATH = "/v1/panorama"
MEDIA_TYPES: dict[PanoramaFormat, str] = {"hdr": "image/vnd.radiance", "exr": "image/x-exr"}
_NUMBER = r"-?[0-9]{1,4}(\.[0-9]{1,6})?"
At = Annotated[
    str | None,
    # Described and not enforced: the answer to another text is one line, as all refusals are.
    Query(description="x,y,z in metres", json_schema_extra={"pattern": f"^{_NUMBER},{_NUMBER},{_NUMBER}$"}),
]
_TEXT: dict[str, Any] = {"content": {"text/plain": {}}}


def add_panorama(app: FastAPI, service: Service, authenticator: Authenticator) -> None:
    """Add one route a format, with the same access rules as the stream."""
    for format_ in MEDIA_TYPES:
        _add_route(app, service, authenticator, format_)


def _add_route(app: FastAPI, service: Service, authenticator: Authenticator, format_: PanoramaFormat) -> None:
    responses: dict[int | str, dict[str, Any]] = {
        200: {"description": "The file", "content": {MEDIA_TYPES[format_]: {}}},
        400: _TEXT | {"description": "`at` is not a place"},
        404: _TEXT | {"description": "No such session, or one without the right key"},
        409: _TEXT | {"description": "The session has no light yet"},
        503: _TEXT | {"description": "The session is busy"},
    }

    @app.get(f"{PANORAMA_PATH}.{format_}", response_class=Response, responses=REFUSED | responses)
    async def panorama(
        request: Request,
        at: At = None,
        session: str | None = None,
        room: str | None = None,
        room_key: str | None = None,
    ) -> Response:
        if (refusal := await refused(authenticator, request)) is not None:
            return refusal
        headers = shared_headers(request, cached="no-store")

        def failed(status: int, reason: str) -> Response:
            return PlainTextResponse(f"{one_line(reason)}\n", status_code=status, headers=headers)

        try:
            order = PanoramaOrder(format_, None if at is None else _place(at))
        except ValueError as error:
            return failed(400, str(error))
        try:
            data = await service.panorama(order, session, room, room_key)
        except NoSession as error:
            return failed(404, f"{error}: a panorama is made while a session streams")
        except TimeoutError:
            return failed(503, "the session is busy: try again later")
        except ValueError as error:
            return failed(409, str(error))
        return Response(data, media_type=MEDIA_TYPES[format_], headers=headers)


def _place(text: str) -> Vector3:
    """`x,y,z`, metres in the world of the session. Raises ValueError, one line."""
    try:
        x, y, z = (float(word) for word in text.split(","))
    except ValueError:
        x = y = z = math.nan
    if not all(map(math.isfinite, (x, y, z))):
        raise ValueError(f"at={text[:80]}: expected x,y,z, three finite numbers in metres")
    return x, y, z
