"""Plays a client against a server: the rules of the wire page that a client sees kept, each on its own connection."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from protocol.conformance.report import Broken, Line
from protocol.conformance.scene import HEIGHT, WIDTH, frame, hello, place
from protocol.conformance.wire_socket import PATIENCE_S, Socket
from protocol.limits import MAX_MESSAGE_BYTES, SUBPROTOCOL

Dial = Callable[..., Socket]
CHECKS: list[tuple[str, str, Callable[[Dial], None]]] = []


def check_server(url: str, token: str | None = None, patience_s: float = PATIENCE_S) -> Iterator[Line]:
    """Run all checks, in order; an answer may take `patience_s`. A server that cannot be reached raises OSError."""
    for rule, section, holds in [*CHECKS, *([_TOKEN] if token else [])]:
        sockets: list[Socket] = []

        def dial(sockets: list[Socket] = sockets, token: str | None = token, **options: Any) -> Socket:
            sockets.append(Socket(url, token, patience_s, **options))
            return sockets[-1]

        failure = None
        try:
            holds((lambda **_: dial(token=None)) if holds is _refuses_without_token else dial)
        except Broken as broken:
            failure = str(broken)
        finally:
            for socket in sockets:
                socket.close()
        yield Line(rule, section, failure)


def _rule(rule: str, section: str) -> Callable[[Callable[[Dial], None]], Callable[[Dial], None]]:
    def add(holds: Callable[[Dial], None]) -> Callable[[Dial], None]:
        CHECKS.append((rule, section, holds))
        return holds

    return add


def _require(is_so: bool, seen: object) -> None:
    if not is_so:
        raise Broken(f"it is {seen}")


def _require_end(socket: Socket, *codes: int) -> str:
    """The connection ends with one of `codes` and a reason, which a fatal error has told before. The reason."""
    code, reason, messages = socket.ending()
    if code not in codes:
        raise Broken(f"closed with {code} {reason!r}, not {' or '.join(map(str, codes))}")
    return " ".join([reason, *(str(each.get("reason", "")) for each in messages)])


def _greeted(dial: Dial, **fields: Any) -> Socket:
    socket = dial()
    socket.say(hello(**fields))
    socket.hear_a("welcome")
    return socket


def _require_answer(socket: Socket, number: int, last: str = "composite") -> dict[str, Any]:
    light = socket.hear_a("light")
    _require(light["frame"] == number, f"light of frame {light['frame']}, not {number}")
    drawn = socket.hear_a(last)
    _require(drawn["frame"] == number, f"{last} of frame {drawn['frame']}, not {number}")
    return drawn


@contextmanager
def _goes_on(socket: Socket) -> Iterator[None]:
    """What is wrong does not end the session: the next frame is answered."""
    yield
    socket.say(frame(99))
    _require_answer(socket, 99)


@_rule(f"the subprotocol {SUBPROTOCOL} is selected", "Transport")
def _selects_subprotocol(dial: Dial) -> None:
    _require(dial().subprotocol == SUBPROTOCOL, "not selected")


@_rule("another version is closed with 1002 and told which one is spoken", "Transport")
def _refuses_version(dial: Dial) -> None:
    reason = _require_end(dial(subprotocol="probeless-v999"), 1002)
    _require(SUBPROTOCOL in reason, f"the reason {reason!r}")


@_rule("a text message is refused with 1003", "Limits")
def _refuses_text(dial: Dial) -> None:
    socket = dial()
    socket.say("hello")
    _require_end(socket, 1003)


@_rule("bytes that are no message are refused with 1007", "Limits")
def _refuses_noise(dial: Dial) -> None:
    socket = dial()
    socket.say(b"\xc1\xff\x00")
    _require_end(socket, 1007)


@_rule("a message above 16 MiB is refused with 1009", "Limits")
def _refuses_large(dial: Dial) -> None:
    socket = dial()
    socket.say(bytes(MAX_MESSAGE_BYTES + 1))
    _require_end(socket, 1009)


@_rule("a first message that is neither hello nor watch is refused with 1008", "A session")
def _refuses_frame_first(dial: Dial) -> None:
    socket = dial()
    socket.say(frame(0))
    _require_end(socket, 1008)


@_rule("a hello without its fields is refused with all their names", "Limits")
def _names_missing(dial: Dial) -> None:
    socket = dial()
    socket.say({"type": "hello", "camera": {"width": 32, "height": 24}})
    reason = _require_end(socket, 1007, 1008)
    for name in ("client", "fx", "fy", "cx", "cy"):
        _require(name in reason, f"{reason!r}, without {name}")


@_rule("a field that there is not is refused by name", "Transport")
def _refuses_unknown(dial: Dial) -> None:
    socket = dial()
    socket.say(hello(colour="red"))
    _require("colour" in (reason := _require_end(socket, 1007, 1008)), repr(reason))


@_rule("a camera that there cannot be is refused by the field's name", "Spaces and units")
def _refuses_camera(dial: Dial) -> None:
    for field, value in (("fx", 1e-37), ("fy", 1e30), ("cx", 1e30), ("distortion", [-100, 100, 0, 0, -100])):
        socket = dial()
        socket.say(hello(camera={**hello()["camera"], field: value}))
        _require(field in (reason := _require_end(socket, 1007, 1008)), repr(reason))


@_rule("hello is answered by welcome", "A session")
def _welcomes(dial: Dial) -> None:
    socket = dial()
    socket.say(hello())
    welcome = socket.hear_a("welcome")
    _require(welcome["max_inflight"] >= 1, f"max_inflight {welcome['max_inflight']}")


@_rule("a second hello is refused with 1008", "A session")
def _refuses_second_hello(dial: Dial) -> None:
    socket = _greeted(dial)
    socket.say(hello())
    _require_end(socket, 1008)


@_rule("a frame is answered by its light and its composite, of the camera's size and the frame's pose", "A session")
def _answers_frame(dial: Dial) -> None:
    socket = _greeted(dial)
    socket.say(frame(7))
    color = _require_answer(socket, 7)["color"]
    _require((color["width"], color["height"]) == (WIDTH, HEIGHT), f"{color['width']}x{color['height']}")


@_rule("a light has 16 coefficients, 27 floats for WebXR, all finite", "Light")
def _light_is_whole(dial: Dial) -> None:
    socket = _greeted(dial, wishes={**hello()["wishes"], "answer": "light"})
    socket.say(frame(0))
    light = socket.hear_a("light")
    _require(len(light["sh"]) == len(light["sh_std"]) == 16, f"{len(light['sh'])} coefficients")
    _require(len(light["sh_webxr"]) == 27, f"{len(light['sh_webxr'])} floats")
    numbers = [*light["sh_webxr"], *(value for row in light["sh"] for value in row), *light["dominant_direction"]]
    _require(all(map(math.isfinite, numbers)), "not finite")
    socket.say(frame(1))  # the light was the whole answer
    _require((after := socket.hear_a("light"))["frame"] == 1, f"frame {after['frame']}")


@_rule("with answer: layer a layer replaces the composite", "Layers")
def _answers_layer(dial: Dial) -> None:
    socket = _greeted(dial, wishes={**hello()["wishes"], "answer": "layer"})
    socket.say(frame(0))
    _require_answer(socket, 0, "layer")


@_rule("a frame with an invalid field is dropped by its number and the session goes on", "A session")
def _drops_invalid(dial: Dial) -> None:
    socket = _greeted(dial)
    turned_inside_out = [2.0, *frame(0)["world_from_camera"][1:]]
    wrong: tuple[dict[str, Any], ...]
    wrong = ({"timestamp_s": math.nan}, {"world_from_camera": turned_inside_out}, {"depth": {"width": 1}}, {"extra": 1})
    with _goes_on(socket):
        for number, fields in enumerate(wrong):
            socket.say(frame(number, **fields))
            dropped = socket.hear_a("dropped")
            _require(dropped["frame"] == number, f"frame {dropped['frame']}")
            name = next(iter(fields))
            _require(name in dropped["reason"], f"the reason {dropped['reason']!r}, without {name}")


@_rule("a picture of another size, or of other bytes than declared, is dropped and the session goes on", "Limits")
def _drops_wrong_pictures(dial: Dial) -> None:
    socket = _greeted(dial)
    good = frame(0)
    wrong = (
        {"depth": {**good["depth"], "width": WIDTH - 1}},
        {"depth": {**good["depth"], "data": good["depth"]["data"][:-1]}},
        {"color": {**good["color"], "data": good["color"]["data"] + b"\0"}},
        {"color": {**good["color"], "codec": "png", "data": b"\x89PNG"}},
        {"depth": {**good["depth"], "codec": "zdelta", "data": b"\xff" * 40}},
    )
    with _goes_on(socket):
        for number, fields in enumerate(wrong):
            socket.say(frame(number, **fields))
            _require((dropped := socket.hear_a("dropped"))["frame"] == number, f"frame {dropped['frame']}")


@_rule("each of max_inflight frames gets exactly one answer", "Flow control")
def _answers_window(dial: Dial) -> None:
    socket = dial()
    socket.say(hello(max_inflight=5))
    window = socket.hear_a("welcome")["max_inflight"]
    _require(1 <= window <= 5, f"max_inflight {window}, of 5 that were asked for")
    answered: list[int] = []
    for number in range(window):
        socket.say(frame(number))
    while len(answered) < window:
        message = socket.hear_a("light", "composite", "dropped")
        answered += [message["frame"]] if message["type"] != "light" else []
    _require(sorted(answered) == list(range(window)), f"answers {answered}")
    with _goes_on(socket):
        pass


@_rule("a request is acknowledged by its number; a repeated one is acknowledged again", "Connections that are lost")
def _acknowledges(dial: Dial) -> None:
    socket = _greeted(dial)
    with _goes_on(socket):
        for request in (5, 5):
            socket.say(place(request))
            acknowledged = socket.hear_a("acknowledged")
            _require(acknowledged["request"] == 5, f"request {acknowledged['request']}")
            _require(acknowledged.get("error") is None, acknowledged.get("error"))


@_rule("a request that cannot be met is acknowledged with an error and the session goes on", "A session")
def _acknowledges_errors(dial: Dial) -> None:
    socket = _greeted(dial)
    wrong = (
        {"type": "move_object", "request": 1, "object": "nothing", "position_m": [0, 0, 0]},
        {"type": "remove_object", "request": 2, "object": "nothing"},
        {"type": "move_object", "request": 3, "object": "a", "position_m": [0, 0, 1e30]},
        {"type": "quality", "request": 4, "preset": "best"},
    )
    with _goes_on(socket):
        for message in wrong:
            socket.say(message)
            acknowledged = socket.hear_a("acknowledged")
            _require(acknowledged["request"] == message["request"], f"request {acknowledged['request']}")
            _require(bool(acknowledged.get("error")), f"no error for {message['type']}")


@_rule("a session with keep_s is resumed by its key after its connection broke", "Connections that are lost")
def _resumes(dial: Dial) -> None:
    socket = dial()
    socket.say(hello(keep_s=60.0))
    welcome = socket.hear_a("welcome")
    _require(bool(welcome.get("key")), "a welcome without key")
    socket.cut()
    again = dial()
    again.say(hello(resume=welcome["key"]))
    resumed = again.hear_a("welcome")
    _require(bool(resumed.get("resumed")), "not resumed")
    _require(resumed["session"] == welcome["session"], f"session {resumed['session']}")
    again.say(frame(3))
    _require_answer(again, 3)


@_rule("a session that there is not, or that ended with a bye, is refused with 4410", "Connections that are lost")
def _refuses_ended(dial: Dial) -> None:
    stranger = dial()
    stranger.say(hello(resume="no such key"))
    _require_end(stranger, 4410)
    socket = dial()
    socket.say(hello(keep_s=60.0))
    key = socket.hear_a("welcome").get("key")
    _require(bool(key), "a welcome without key")
    socket.say({"type": "bye"})
    _require_end(socket, 1000)
    again = dial()
    again.say(hello(resume=key))
    _require_end(again, 4410)


@_rule("a watcher gets the light and the composite of each frame", "A session")
def _shows_watchers(dial: Dial) -> None:
    socket = dial()
    socket.say(hello())
    session = socket.hear_a("welcome")["session"]
    watcher = dial()
    watcher.say({"type": "watch", "session": session})
    watcher.hear_a("welcome")
    socket.say(frame(0))
    _require_answer(socket, 0)
    _require_answer(watcher, 0)


@_rule("a watcher is told the lens, and its requests for objects are acknowledged to it alone", "A session")
def _takes_requests_of_watchers(dial: Dial) -> None:
    socket = dial()
    socket.say(hello())
    session = socket.hear_a("welcome")["session"]
    watcher = dial()
    watcher.say({"type": "watch", "session": session})
    lens = watcher.hear_a("welcome").get("camera")
    is_told = lens is not None and lens["width"] == hello()["camera"]["width"]
    _require(is_told, f"the camera in the watcher's welcome: {lens}")
    watcher.say({"type": "remove_object", "request": 7, "object": "nothing"})
    done = watcher.hear_a("acknowledged")
    _require(done["request"] == 7 and bool(done.get("error")), f"the answer {done}")
    socket.say(frame(0))
    _require(socket.hear()["type"] != "acknowledged", "an acknowledgement to the capturing client")


@_rule("mesh parts follow on without gaps, then the request is acknowledged", "A session")
def _sends_mesh(dial: Dial) -> None:
    socket = _greeted(dial)
    socket.say(frame(0))
    _require_answer(socket, 0)
    socket.say({"type": "request_mesh", "request": 1})
    received: dict[str, int] = {}
    sizes: dict[str, int] = {}
    while (message := socket.hear_a("mesh_part", "acknowledged"))["type"] == "mesh_part":
        kind = message["format"]
        _require(message["offset"] == received.get(kind, 0), f"a part of {kind} at {message['offset']}")
        received[kind] = message["offset"] + len(message["data"])
        sizes[kind] = message["size_bytes"]
    _require(received == sizes, f"{received} of {sizes} bytes")


@_rule("bye is answered by a close with 1000", "Limits")
def _ends_with_bye(dial: Dial) -> None:
    socket = _greeted(dial)
    socket.say({"type": "bye"})
    _require_end(socket, 1000)


def _refuses_without_token(dial: Dial) -> None:
    _require_end(dial(), 4401)


_TOKEN = ("a socket without the token is refused with 4401", "Transport", _refuses_without_token)
