"""ROS 2 bags, MCAP or SQLite: a folder with metadata.yaml, an .mcap or a .db3 file. Needs rosbags.

Topics are chosen by type and content, and named in a note: colour (sensor_msgs Image or CompressedImage), depth (16UC1
millimetres or 32FC1 metres, aligned to colour), camera_info of colour, and the camera's path: tf and tf_static, or
nav_msgs Odometry. A picture's frame is an optical one (REP 104: +x right, +y down, +z forward); world +z is up
(REP 103).
"""

from __future__ import annotations

import weakref
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from client.errors import SourceError
from client.progress import note
from client.sources.datasets.decoded import DecodedSource, Lens, Pose, Read, camera_of, frame_rate, millimetres
from client.sources.files.ros_frames import FrameTree
from client.sources.files.ros_pictures import color_of, depth_of, is_color, is_depth
from protocol.frames import NO_DISTORTION, Distortion

LOOKED_FOR = "a folder with metadata.yaml, an .mcap or a .db3 (ROS 2 bag)"
UP = (0.0, 0.0, 1.0)
SAME_TIME_NS = 20_000_000
"""Between colour and depth of one frame, as in the association of TUM RGB-D."""

IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
CAMERA_INFO, TF, ODOMETRY = "sensor_msgs/msg/CameraInfo", "tf2_msgs/msg/TFMessage", "nav_msgs/msg/Odometry"
_MCAP, _SQLITE = b"\x89MCAP0\r\n", b"SQLite format 3\0"


@dataclass(frozen=True)
class _Picture:
    """One picture in the bag."""

    time_ns: int
    """Of its header."""
    logged_ns: int
    """When the bag recorded it: by this it is found again."""


@dataclass(frozen=True)
class _Topic:
    connection: Any
    frame: str
    size: tuple[int, int] | None
    """(width, height); None: compressed."""


def recognises(_path: Path, head: bytes) -> bool:
    """Whether the file is MCAP or SQLite."""
    return head.startswith((_MCAP, _SQLITE))


def is_bag_folder(folder: Path) -> bool:
    """Whether the folder has the description of a bag."""
    path = folder / "metadata.yaml"
    return path.is_file() and b"rosbag2_bagfile_information" in path.read_bytes()[:4096]


def open_file(path: Path) -> DecodedSource:
    """The capture in a bag. Raises SourceError."""
    if find_spec("rosbags") is None:
        raise SourceError(
            f"{path}: ROS 2 bags need rosbags, which is not installed: make install-import, or pip install rosbags"
        )
    from rosbags.highlevel import AnyReader, AnyReaderError
    from rosbags.typesys import Stores, get_typestore

    def opened() -> DecodedSource:
        reader = AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
        reader.open()
        try:
            source = _open(path, reader)
        except BaseException:
            reader.close()
            raise
        read = partial(_on_thread, thread, source.read)
        weakref.finalize(read, _close, thread, reader).atexit = False
        return replace(source, read=read)

    # SQLite refuses a reader on another thread than the one that opened it; `stream` reads frames on any.
    thread = ThreadPoolExecutor(1, "bag")
    try:
        return thread.submit(opened).result()
    except (AnyReaderError, OSError) as error:
        raise SourceError(f"{path}: cannot be read as a ROS 2 bag: {' '.join(str(error).split())}") from error


def _on_thread(thread: ThreadPoolExecutor, read: Read, index: int) -> tuple[NDArray[Any], NDArray[np.uint16]]:
    return thread.submit(read, index).result()


def _close(thread: ThreadPoolExecutor, reader: Any) -> None:
    thread.submit(reader.close)
    thread.shutdown(wait=False)


def _open(path: Path, reader: Any) -> DecodedSource:
    color, depth = _topics(path, reader)
    info = _camera_info(path, reader, color, depth)
    frames = _paired(path, reader, color.connection, depth.connection)
    tree = FrameTree.of(reader, TF, ODOMETRY)
    poses: list[Pose | None] = [tree.world_from(color.frame, c.time_ns * 1e-9) for c, _ in frames]
    placed = [i for i, pose in enumerate(poses) if pose is not None]
    _say_choice(path, color, depth, tree.path_of(color.frame), len(frames), len(placed))
    known: tuple[Pose, ...] | None = None
    if placed:
        frames = [frames[i] for i in placed]
        known = tuple(pose for pose in poses if pose is not None)
    times_s = tuple(picture.time_ns * 1e-9 for picture, _ in frames)
    lens, distortion = _lens(path, info, color.connection.topic)
    first = _decoded_depth(path, reader, depth.connection, frames[0][1])
    camera = camera_of(path, lens, lens.resized(first.shape[1], first.shape[0]), distortion=distortion)
    read = partial(_read, path, reader, color.connection, depth.connection, frames)
    return DecodedSource(path.resolve().name, camera, frame_rate(times_s), UP if known else None, times_s, known, read)


def _say_choice(path: Path, color: _Topic, depth: _Topic, chain: str, frames: int, placed: int) -> None:
    said = f"{path.name}: colour {color.connection.topic}, depth {depth.connection.topic}, "
    if not placed:
        note(f"{said}no path of the camera {color.frame!r} in tf or odometry: it is tracked")
        return
    note(f"{said}path {chain}" + (f"; {frames - placed} of {frames} frames without it left out" * (placed < frames)))


def _topics(path: Path, reader: Any) -> tuple[_Topic, _Topic]:
    """Colour and depth. Of several colours that with `color` or `rgb` in its name, of depths that with `aligned`."""
    colors, depths = [], []
    for connection in sorted(reader.connections, key=lambda c: c.topic):
        if connection.msgtype not in (IMAGE, COMPRESSED):
            continue
        message = _first(reader, connection)
        if message is None:
            continue
        raw = connection.msgtype == IMAGE
        size = (message.width, message.height) if raw else None
        topic = _Topic(connection, message.header.frame_id, size)
        if is_depth(message):
            depths.append(topic)
        elif is_color(message):
            colors.append(topic)
    if not colors or not depths:
        kind = "colour" if not colors else "depth (16UC1 or 32FC1)"
        there = ", ".join(sorted({f"{c.topic} ({c.msgtype})" for c in reader.connections})) or "nothing"
        raise SourceError(f"{path}: holds no topic with pictures of {kind}; there is {there}")
    color = min(colors, key=lambda t: not any(word in t.connection.topic for word in ("color", "rgb")))
    depth = min(depths, key=lambda t: ("aligned" not in t.connection.topic, t.frame != color.frame))
    if depth.frame != color.frame:
        raise SourceError(
            f"{path}: depth {depth.connection.topic} is of {depth.frame!r}, not aligned to colour of {color.frame!r}; "
            "record the depth that is registered to colour"
        )
    return color, depth


def _first(reader: Any, connection: Any) -> Any:
    for found, _, data in reader.messages(connections=[connection]):
        return reader.deserialize(data, found.msgtype)
    return None


def _camera_info(path: Path, reader: Any, color: _Topic, depth: _Topic) -> Any:
    """Of colour: from the topic beside it, else one of the same frame, else that of the aligned depth."""
    near = [_parent(color.connection.topic), _parent(_parent(color.connection.topic)), _parent(depth.connection.topic)]
    infos = [c for c in sorted(reader.connections, key=lambda c: c.topic) if c.msgtype == CAMERA_INFO]
    for wanted in near:
        for connection in infos:
            if _parent(connection.topic) == wanted and (message := _first(reader, connection)) is not None:
                return message
    for connection in infos:
        message = _first(reader, connection)
        if message is not None and message.header.frame_id == color.frame:
            return message
    raise SourceError(f"{path}: has no camera_info for {color.connection.topic}; record that topic too")


def _parent(topic: str) -> str:
    return topic.rpartition("/")[0]


def _lens(path: Path, info: Any, topic: str) -> tuple[Lens, Distortion]:
    """Of a rectified picture (image_proc: `image_rect` in its topic) the projection P holds, else K and D."""
    k, d = np.asarray(info.k, np.float64), np.asarray(info.d, np.float64)
    if "image_rect" in topic:
        k, d = np.asarray(info.p, np.float64)[[0, 1, 2, 4, 5, 6, 8, 9, 10]], np.zeros(0)
    if np.any(d) and (info.distortion_model not in ("plumb_bob", "rational_polynomial") or np.any(d[5:])):
        raise SourceError(
            f"{path}: distortion {info.distortion_model} with {len(d)} coefficients is not read; record rectified "
            "pictures, or plumb_bob"
        )
    padded = [float(x) for x in np.concatenate([d, np.zeros(5)])[:5]]
    distortion = (padded[0], padded[1], padded[2], padded[3], padded[4]) if np.any(d) else NO_DISTORTION
    return Lens(int(info.width), int(info.height), *(float(k[i]) for i in (0, 4, 2, 5))), distortion


def _paired(path: Path, reader: Any, color: Any, depth: Any) -> list[tuple[_Picture, _Picture]]:
    """Each colour with the nearest depth; each depth once."""
    colors, depths = _pictures(reader, color), _pictures(reader, depth)
    times = np.array([picture.time_ns for picture in depths], np.int64)
    pairs: dict[int, _Picture] = {}
    for picture in colors:
        apart = np.abs(times - picture.time_ns)
        nearest = int(apart.argmin())
        rival = pairs.get(nearest)
        if apart[nearest] <= SAME_TIME_NS and (rival is None or apart[nearest] < abs(times[nearest] - rival.time_ns)):
            pairs[nearest] = picture
    if not pairs:
        raise SourceError(f"{path}: no {color.topic} and {depth.topic} lie within 20 ms of each other")
    found = [(picture, depths[nearest]) for nearest, picture in pairs.items()]
    return sorted(found, key=lambda pair: pair[0].time_ns)


def _pictures(reader: Any, connection: Any) -> list[_Picture]:
    found = []
    for topic, logged_ns, data in reader.messages(connections=[connection]):
        stamp = reader.deserialize(data, topic.msgtype).header.stamp
        found.append(_Picture(stamp.sec * 10**9 + stamp.nanosec or logged_ns, logged_ns))
    return found


def _read(
    path: Path, reader: Any, color: Any, depth: Any, frames: list[tuple[_Picture, _Picture]], index: int
) -> tuple[NDArray[Any], NDArray[np.uint16]]:
    shown, measured = frames[index]
    where = f"{path}: {color.topic}, frame {index}"
    return color_of(_message(path, reader, color, shown), where), _decoded_depth(path, reader, depth, measured)


def _decoded_depth(path: Path, reader: Any, depth: Any, picture: _Picture) -> NDArray[np.uint16]:
    values = depth_of(_message(path, reader, depth, picture), f"{path}: {depth.topic}")
    return values if values.dtype == np.uint16 else millimetres(values)


def _message(path: Path, reader: Any, connection: Any, picture: _Picture) -> Any:
    at = picture.logged_ns
    for found, _, data in reader.messages(connections=[connection], start=at, stop=at + 1):
        return reader.deserialize(data, found.msgtype)
    raise SourceError(f"{path}: a picture of {connection.topic} is gone; was the bag changed?")
