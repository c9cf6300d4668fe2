"""docs/examples/three_scene.html in Chromium: the scene is drawn, and its light comes from where it is."""

from __future__ import annotations

import functools
import http.server
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np

from client.results.gltf_scene import scene_glb
from server.light.panorama_file import encode_panorama
from tests.client.gltf_scenes import CAMERA, square
from tests.client.web.conftest import OpenPage
from tests.data import ROOT
from tests.node import installed_modules

CDN = "https://cdn.jsdelivr.net/npm/three@0.187.0"
"""Of the version that package.json pins."""


@contextmanager
def served(folder: Path) -> Iterator[str]:
    """The address of a server of files."""

    class Quiet(http.server.SimpleHTTPRequestHandler):
        def log_message(self, *_arguments: object) -> None:
            """No line for each file."""

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Quiet, directory=str(folder)))
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}"
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


def test_the_light_of_a_scene_comes_from_where_it_is(tmp_path: Path, open_page: OpenPage) -> None:
    """Red to the left of the first view, blue to the right, green added above: the page's background shows it."""
    text = (ROOT / "docs" / "examples" / "three_scene.html").read_text()
    assert CDN in text
    (tmp_path / "scene.html").write_text(text.replace(CDN, "/three"))
    (tmp_path / "three").symlink_to(installed_modules() / "three")
    ahead = np.diag([1.0, -1.0, -1.0, 1.0])
    data = scene_glb(square(np.eye(3)), [], [], [(0.0, ahead)], CAMERA, "scene.hdr")
    (tmp_path / "scene.glb").write_bytes(data)
    picture = np.zeros((128, 256, 3))
    picture[:, :128, 0] = picture[:, 128:, 2] = picture[:56, :, 1] = 1
    (tmp_path / "scene.hdr").write_bytes(encode_panorama(picture, "hdr"))
    with served(tmp_path) as address:
        page = open_page(f"{address}/scene.html?background", size=(320, 240))
        page.wait_for_selector("body[data-drawn]")
        shot = cv2.imdecode(np.frombuffer(page.screenshot(), np.uint8), cv2.IMREAD_COLOR_RGB)
    corners = shot[[5, 5, -5, -5], [5, -5, 5, -5]] > 128
    assert corners.tolist() == [[True, True, False], [False, True, True], [True, False, False], [False, False, True]]
