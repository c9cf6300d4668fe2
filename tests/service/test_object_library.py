"""The server's library of objects: what it lists and gives, to whom, and that nothing else of the disk is in it."""

from __future__ import annotations

from pathlib import Path

import httpx
import pytest

from protocol.limits import MAX_MESH_BYTES
from server.scene.mesh import load_mesh
from server.service.edge.authenticator import Authenticator
from server.service.routes.object_library import MAX_OBJECTS, NoObject, ObjectLibrary
from tests.service.fakes import PATIENCE_S

TOKEN = "a-token"
TRIANGLE = b"v 0 0 0\nv 0.2 0 0\nv 0 0.2 0\nf 1 2 3\n"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """With one model, and what must not be got at beside it."""
    models = tmp_path / "models"
    models.mkdir()
    (models / "tri angle.obj").write_bytes(TRIANGLE)
    (models / "notes.txt").write_text("no model")
    (models / ".hidden.obj").write_bytes(TRIANGLE)
    (models / "empty.obj").touch()
    (models / "inner").mkdir()
    (models / "inner" / "deep.obj").write_bytes(TRIANGLE)
    (tmp_path / "secret.obj").write_bytes(b"secret")
    (models / "link.obj").symlink_to(tmp_path / "secret.obj")
    (models / "inside.obj").symlink_to(models / "tri angle.obj")
    return models


@pytest.fixture
def ask(start_server, folder: Path):
    """GET a path of a server with that folder."""
    server = start_server(
        library=ObjectLibrary(folder), authenticator=Authenticator(TOKEN, frozenset({"https://app.example"}))
    )

    def get(path: str, headers: dict[str, str] | None = None, token: str | None = TOKEN) -> httpx.Response:
        headers = (headers or {}) | ({} if token is None else {"Authorization": f"Bearer {token}"})
        return httpx.get(server.url + path, headers=headers, trust_env=False, timeout=PATIENCE_S)

    return get


def names(library: ObjectLibrary) -> list[str]:
    return [offered.name for offered in library.listing()]


def test_the_folder_and_the_vase_are_listed_and_given(ask) -> None:
    listed = ask("/v1/objects").json()["objects"]
    assert [entry["name"] for entry in listed] == ["inside.obj", "tri angle.obj", "vase.glb"]
    assert listed[1] == {"name": "tri angle.obj", "format": "obj", "size_bytes": len(TRIANGLE)}
    assert ask("/v1/objects/tri%20angle.obj").content == TRIANGLE
    vase = ask("/v1/objects/vase.glb")
    assert vase.headers["content-type"] == "model/gltf-binary"
    assert len(vase.content) == listed[2]["size_bytes"]
    low, high = load_mesh(vase.content, "glb").bounds
    assert high[1] - low[1] == pytest.approx(0.24, abs=2e-3)


def test_what_changes_in_the_folder_is_seen_at_once(ask, folder: Path) -> None:
    etag = ask("/v1/objects/tri%20angle.obj").headers["etag"]
    assert ask("/v1/objects/tri%20angle.obj", {"If-None-Match": etag}).status_code == 304
    (folder / "tri angle.obj").write_bytes(TRIANGLE + b"\n")
    assert ask("/v1/objects/tri%20angle.obj", {"If-None-Match": etag}).content == TRIANGLE + b"\n"
    (folder / "new.stl").write_bytes(b"solid")
    assert "new.stl" in ask("/v1/objects").text
    (folder / "new.stl").unlink()
    gone = ask("/v1/objects/new.stl")
    assert gone.status_code == 404
    assert "no such object" in gone.text
    assert gone.text.count("\n") == 1


@pytest.mark.parametrize(
    "name",
    [
        "..%2Fsecret.obj",
        "%2E%2E/secret.obj",
        "link.obj",
        "notes.txt",
        ".hidden.obj",
        "inner",
        "inner%2Fdeep.obj",
        "%00",
    ],
)
def test_nothing_else_of_the_disk_is_given(ask, name: str) -> None:
    response = ask(f"/v1/objects/{name}")
    assert response.status_code == 404
    assert b"secret" not in response.content


@pytest.mark.parametrize("name", ["../secret.obj", "/etc/passwd", "inner/deep.obj", "inner", "", "..", "vase.glb/"])
def test_a_name_is_no_path(folder: Path, name: str) -> None:
    with pytest.raises(NoObject):
        ObjectLibrary(folder).read(name)


def test_only_whoever_has_the_token_gets_in(ask) -> None:
    for path in ("/v1/objects", "/v1/objects/vase.glb"):
        for token, word in ((None, "missing"), ("another", "wrong")):
            refused = ask(path, token=token)
            assert refused.status_code == 401
            assert f"the token is {word}" in refused.text
    assert ask("/v1/objects?token=" + TOKEN, token=None).status_code == 200


def test_only_pages_that_are_allowed_may_read_it(ask) -> None:
    assert ask("/v1/objects", {"Origin": "https://evil.example"}).status_code == 403
    allowed = ask("/v1/objects", {"Origin": "https://app.example"})
    assert allowed.headers["access-control-allow-origin"] == "https://app.example"
    assert "access-control-allow-origin" not in ask("/v1/objects").headers


def test_models_too_large_for_a_message_are_left_out(folder: Path) -> None:
    with (folder / "large.stl").open("wb") as file:
        file.truncate(MAX_MESH_BYTES + 1)
    library = ObjectLibrary(folder)
    assert "large.stl" not in names(library)
    with pytest.raises(NoObject):
        library.read("large.stl")


def test_a_listing_ends_somewhere(tmp_path: Path) -> None:
    for number in range(MAX_OBJECTS + 3):
        (tmp_path / f"{number:05}.obj").write_bytes(TRIANGLE)
    assert len(names(ObjectLibrary(tmp_path))) == MAX_OBJECTS + 1


def test_a_folder_that_went_away_is_an_empty_one(tmp_path: Path) -> None:
    library = ObjectLibrary(tmp_path / "gone")
    assert names(library) == ["vase.glb"]
    with pytest.raises(NoObject):
        library.read("sofa.glb")
