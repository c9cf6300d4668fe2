"""What the options of `serve` amount to."""

from __future__ import annotations

from pathlib import Path

import pytest

from client.errors import OptionError
from client.options.serve_options import ServeOptions, authenticator_of, certificate_of, limits_of, objects_folder


def test_a_token_is_made_unless_one_is_given() -> None:
    made = {authenticator_of(ServeOptions(host="127.0.0.1")).token for _ in range(2)}
    assert len(made) == 2
    assert None not in made
    assert authenticator_of(ServeOptions(host="0.0.0.0", token="x")).token == "x"


def test_no_token_must_be_said_twice_where_others_reach_it() -> None:
    for host in ("127.0.0.1", "localhost", "::1"):
        assert authenticator_of(ServeOptions(host=host, token="none")).token is None
    for host in ("0.0.0.0", "::", "192.0.2.1", "room.example"):
        with pytest.raises(OptionError, match=f"reaches {host}"):
            authenticator_of(ServeOptions(host=host, token="none"))
        assert authenticator_of(ServeOptions(host=host, token="none", insecure=True)).token is None


def test_origins_are_as_a_browser_writes_them() -> None:
    authenticator = authenticator_of(
        ServeOptions(host="127.0.0.1", allow_origin=("https://App.example/", "http://room:8080"))
    )
    assert authenticator.origins == {"https://app.example", "http://room:8080"}
    for wrong in ("app.example", "https://", "https://app.example/path", "ws://app.example", "*"):
        with pytest.raises(OptionError, match="--allow-origin"):
            authenticator_of(ServeOptions(host="127.0.0.1", allow_origin=(wrong,)))


def test_limits() -> None:
    assert limits_of(ServeOptions(host="h", volume_memory=64)).volume_bytes == 64 << 20
    assert limits_of(ServeOptions(host="h", sessions=3)).sessions_per_address == 3
    few = limits_of(ServeOptions(host="h", sessions=40, sessions_per_address=5))
    assert (few.sessions, few.sessions_per_address) == (40, 5)


def test_no_tls_unless_asked_for() -> None:
    assert certificate_of(ServeOptions(host="h")) is None


def test_a_folder_of_objects_must_be_one(tmp_path: Path) -> None:
    assert objects_folder(None) is None
    assert objects_folder(tmp_path) == tmp_path
    (tmp_path / "sofa.glb").touch()
    for wrong in ("sofa.glb", "gone"):
        with pytest.raises(OptionError, match=r"--objects .*: no such folder; give one with \.glb"):
            objects_folder(tmp_path / wrong)


def test_limits_of_rooms_on_disk() -> None:
    usual = limits_of(ServeOptions("localhost")).room_retention
    assert (usual.space_bytes, usual.age_s) == (16 << 30, 180 * 86400)
    other = limits_of(ServeOptions("localhost", data_gib=0.5, data_days=2)).room_retention
    assert (other.space_bytes, other.age_s) == (1 << 29, 2 * 86400)
    none = limits_of(ServeOptions("localhost", data_gib=0, data_days=0)).room_retention
    assert (none.space_bytes, none.age_s) == (None, None)


def test_the_token_is_read_from_a_file(tmp_path: Path) -> None:
    file = tmp_path / "token"
    file.write_text("from-a-file\n")
    assert authenticator_of(ServeOptions(host="0.0.0.0", token_file=file)).token == "from-a-file"
    with pytest.raises(OptionError, match="both given"):
        authenticator_of(ServeOptions(host="h", token="x", token_file=file))
    with pytest.raises(OptionError, match="--insecure"):
        authenticator_of(ServeOptions(host="h", insecure=True, token_file=file))


@pytest.mark.parametrize("content", [None, b"", b"\n", b"two words", b"\xff\xfe", b"x" * 257, b"a\nb"])
def test_a_file_without_a_token_is_named_and_not_shown(content: bytes | None, tmp_path: Path) -> None:
    file = tmp_path / "token"
    if content is not None:
        file.write_bytes(content)
    with pytest.raises(OptionError, match="--token-file: ") as refused:
        authenticator_of(ServeOptions(host="h", token_file=file))
    assert str(file) in str(refused.value)
    assert "two words" not in str(refused.value)
