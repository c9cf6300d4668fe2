"""`/metrics` over HTTP: open to this machine, others need the token."""

from __future__ import annotations

import logging
from collections.abc import Callable

from fastapi import FastAPI, Request
from fastapi.responses import PlainTextResponse, Response
from prometheus_client import CONTENT_TYPE_LATEST

from server.service.edge.authenticator import WHERE_IT_IS, Authenticator, address_of

log = logging.getLogger(__name__)


def add_metrics(app: FastAPI, render: Callable[[], bytes], authenticator: Authenticator) -> None:
    """Add the route. `render` gives all metrics in Prometheus's text format."""

    @app.get("/metrics", response_class=PlainTextResponse, responses={401: {"description": "No token"}})
    async def metrics(request: Request) -> Response:
        if not authenticator.shows_metrics_to(request):
            await authenticator.slow_down(request)
            log.info("request refused", extra={"address": address_of(request), "path": request.url.path})
            return PlainTextResponse(f"The token is missing or wrong: {WHERE_IT_IS}.\n", status_code=401)
        return Response(render(), media_type=CONTENT_TYPE_LATEST)
