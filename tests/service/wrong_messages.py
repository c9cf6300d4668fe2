"""Clients that say something wrong, and whether the server serves others after that."""

from websockets.exceptions import ConnectionClosed

from protocol.messages import Acknowledged, Composite, Hello, Quality
from tests.service.fakes import CAMERA, frame_message


def serves_frames(wire, index: int) -> bool:
    """Whether a session still answers."""
    wire.say(frame_message(index))
    return wire.hear_until(Composite)[-1].frame == index


HELLO = Hello(client="test", camera=CAMERA)


def after_control(wire) -> int | None:
    """Wait until the session has come to a control message: None, or the close code if it ended before."""
    try:
        wire.say(Quality(request=99, preset="rm"))
        while not (isinstance(message := wire.hear(), Acknowledged) and message.request == 99):
            pass
    except ConnectionClosed as closed:
        return 1006 if closed.rcvd is None else closed.rcvd.code
    return None
