"""The page's files over HTTP: compressed for browsers that read it, unchanged for others, and not sent twice."""

from __future__ import annotations

import gzip
from pathlib import Path

import httpx
import pytest

from client.web.build import FOLDER
from server.service.serve import BackgroundServer

DIST = FOLDER / "dist"


def get(server: BackgroundServer, path: str, accepts: str, **headers: str) -> httpx.Response:
    """With the bytes as they came."""
    with httpx.Client(trust_env=False) as client:
        request = client.build_request("GET", f"{server.url}/{path}", headers={"accept-encoding": accepts, **headers})
        response = client.send(request, stream=True)
        response.raw = b"".join(response.iter_raw())
        return response


@pytest.mark.parametrize("name", ["app.js", "style.css", "index.html"])
def test_text_comes_compressed_and_is_the_file(server: BackgroundServer, name: str) -> None:
    path = "" if name == "index.html" else name
    zipped, plain = get(server, path, "br, gzip, zstd"), get(server, path, "identity")
    assert (zipped.headers["content-encoding"], plain.headers.get("content-encoding")) == ("gzip", None)
    assert gzip.decompress(zipped.raw) == plain.raw == (DIST / name).read_bytes()
    assert int(zipped.headers["content-length"]) == len(zipped.raw) < 0.5 * len(plain.raw)
    assert zipped.headers["content-type"] == plain.headers["content-type"]
    assert zipped.headers["vary"] == plain.headers["vary"] == "Accept-Encoding"


def test_gzip_that_is_refused_is_not_sent(server: BackgroundServer) -> None:
    assert "content-encoding" not in get(server, "app.js", "gzip;q=0, br").headers


def test_what_gets_no_smaller_comes_as_it_is(server: BackgroundServer) -> None:
    icon = get(server, "icon-192.png", "gzip")
    assert "content-encoding" not in icon.headers
    assert icon.raw == (DIST / "icon-192.png").read_bytes()


def test_a_file_that_the_browser_has_is_not_sent_again(server: BackgroundServer) -> None:
    etag = get(server, "app.js", "gzip").headers["etag"]
    again = get(server, "app.js", "gzip", **{"if-none-match": etag})
    assert (again.status_code, again.raw) == (304, b"")


def test_browsers_may_install_the_page(server: BackgroundServer) -> None:
    found = get(server, "manifest.webmanifest", "identity")
    assert found.headers["content-type"].startswith("application/manifest+json")
    manifest = httpx.Response(200, content=found.raw).json()
    assert manifest["display"] == "standalone"
    assert "start_url" not in manifest  # it is the page's own, with its token
    for icon in manifest["icons"]:
        assert (DIST / icon["src"]).is_file()
        assert Path(icon["src"]).suffix == ".png"
