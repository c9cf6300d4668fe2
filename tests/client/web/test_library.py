"""The server's objects on the page: listed, fetched when they are picked, placed; and files that are dropped."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from playwright.sync_api import Page

from server.scene.vase import vase_glb
from server.service.edge.authenticator import Authenticator
from server.service.routes.object_library import ObjectLibrary
from server.service.serve import BackgroundServer
from tests.client.web.conftest import OpenPage, wait_for_text
from tests.client.web.page import start_capture, wait_until
from tests.client.web.received import CAMERA, frames_seen
from tests.client.web.sequence import of_device
from tests.service.fakes import Lab

SOFA = b"v 0 0 0\nv 2 0 0\nv 0 2 0\nf 1 2 3\n"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Of models on the server."""
    (tmp_path / "red sofa.obj").write_bytes(SOFA)
    return tmp_path


@pytest.fixture
def server_options(folder: Path) -> dict[str, object]:
    return {"authenticator": Authenticator("a-token"), "library": ObjectLibrary(folder)}


@pytest.fixture
def page(server: BackgroundServer, open_page: OpenPage) -> Page:
    """That captures."""
    page = open_page(server.way_in, of_device(CAMERA, frames_seen(3), loops=True))
    start_capture(page)
    wait_for_text(page, "#state", "Live, captured here")
    page.locator("#model optgroup").wait_for(state="attached")
    return page


def place(page: Page, name: str) -> None:
    """In the middle of the picture, as a key does."""
    page.locator("#place").focus()
    page.keyboard.press("Enter")
    wait_for_text(page, "#object-said", f"{name} placed.")


def placed_meshes(page: Page, lab: Lab, count: int) -> list[tuple[str, bytes]]:
    """What the pipeline was given, once there are so many: the page says so before."""

    def given() -> list[tuple[str, bytes]]:
        return [entry[2] for entry in lab.log if entry[0] == "place"]

    wait_until(lambda: len(given()) >= count, page)
    return given()


def test_the_servers_objects_are_listed_fetched_and_placed(
    page: Page, lab: Lab, keep_picture: Callable[[Page, str], None]
) -> None:
    group = page.locator("#model optgroup")
    assert group.get_attribute("label") == "from the server"
    assert group.locator("option").all_text_contents() == ["red sofa", "vase"]
    assert page.locator("#model").input_value() == "Vase"  # the page's own is still the first
    fetched: list[str] = []
    page.on("request", lambda request: fetched.append(request.url) if "/v1/objects/" in request.url else None)
    page.locator("#model").select_option("server:red sofa.obj")
    wait_for_text(page, "#object-said", "red sofa can be placed now.")
    place(page, "red sofa")
    keep_picture(page, "library")
    place(page, "red sofa")
    assert len(fetched) == 1
    page.locator("#model").select_option("server:vase.glb")
    place(page, "vase")
    assert placed_meshes(page, lab, 3) == [("obj", SOFA), ("obj", SOFA), ("glb", vase_glb())]


def test_an_object_that_was_taken_away_is_told_and_another_can_be_placed(page: Page, folder: Path) -> None:
    (folder / "red sofa.obj").unlink()
    page.locator("#model").select_option("server:red sofa.obj")
    wait_for_text(page, "#object-said", "red sofa.obj cannot be fetched: there is no such object on this server")
    page.locator("#model").select_option("server:vase.glb")
    place(page, "vase")


def test_what_is_new_in_the_folder_is_there_in_the_next_session(page: Page, folder: Path) -> None:
    (folder / "lamp.stl").write_bytes(b"solid")
    page.locator("#stop").click()
    wait_for_text(page, "#state", "waiting for a session")
    start_capture(page)
    page.locator("#model option[value='server:lamp.stl']").wait_for(state="attached")


def test_a_file_is_dropped_onto_the_picture_and_onto_the_tools(page: Page, lab: Lab) -> None:
    for target, name in (("#picture-frame", "chair.obj"), ("#model", "table.ply")):
        make = "name => { const all = new DataTransfer(); all.items.add(new File(['a mesh'], name)); return all; }"
        page.dispatch_event(target, "drop", {"dataTransfer": page.evaluate_handle(make, name)})
        wait_for_text(page, "#object-said", f"{name} can be placed now.")
        place(page, name[:-4])
    assert placed_meshes(page, lab, 2) == [("obj", b"a mesh"), ("ply", b"a mesh")]
    make = "() => { const all = new DataTransfer(); all.items.add(new File(['text'], 'letter.txt')); return all; }"
    page.dispatch_event("#object-tools", "drop", {"dataTransfer": page.evaluate_handle(make)})
    wait_for_text(page, "#object-said", "letter.txt is no model that can be placed: choose a .glb, .obj, .ply or .stl")
