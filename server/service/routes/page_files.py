"""The page's files, compressed once for browsers that read gzip."""

from __future__ import annotations

import gzip
import mimetypes
from os import PathLike, stat_result
from pathlib import Path

from starlette.datastructures import Headers
from starlette.responses import Response
from starlette.staticfiles import NotModifiedResponse, StaticFiles
from starlette.types import Scope

WORTH_IT = 0.9
"""A file is sent compressed if that makes it at least this much smaller: pictures and recordings are not."""

mimetypes.add_type("application/manifest+json", ".webmanifest")
mimetypes.add_type("application/octet-stream", ".probeless")


class PageFiles(StaticFiles):
    """Static files of a folder that does not change while the server runs; `/` is index.html."""

    def __init__(self, folder: Path) -> None:
        """Read and compress the files: about a megabyte, a tenth of a second."""
        super().__init__(directory=folder, html=True)
        self._compressed: dict[str, bytes] = {}
        for path in folder.iterdir():
            data = path.read_bytes()
            smaller = gzip.compress(data, 9, mtime=0)
            if len(smaller) < WORTH_IT * len(data):
                self._compressed[str(path.resolve())] = smaller

    def file_response(
        self, full_path: str | PathLike[str], stat_result: stat_result, scope: Scope, status_code: int = 200
    ) -> Response:
        """The file, compressed where the browser reads that."""
        response = super().file_response(full_path, stat_result, scope, status_code)
        data = self._compressed.get(str(Path(full_path).resolve()))
        if data is None:
            return response
        response.headers["vary"] = "Accept-Encoding"
        if isinstance(response, NotModifiedResponse) or not _reads_gzip(Headers(scope=scope)):
            return response
        headers = {name: response.headers[name] for name in ("etag", "last-modified", "vary", "content-type")}
        return Response(data, status_code, {**headers, "content-encoding": "gzip"})


def _reads_gzip(headers: Headers) -> bool:
    """Whether the request accepts gzip (RFC 9110, 12.5.3)."""
    for part in headers.get("accept-encoding", "").lower().split(","):
        name, _, weight = part.strip().partition(";")
        if name.strip() in ("gzip", "x-gzip"):
            return weight.replace(" ", "") not in ("q=0", "q=0.0", "q=0.00", "q=0.000")
    return False
