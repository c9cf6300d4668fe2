"""The tree of coordinate frames in a ROS bag: tf, tf_static and odometry."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from typing import Any

import numpy as np

from client.sources.path_of_camera import CameraPath, Pose
from client.sources.poses import from_quaternion

LARGEST_GAP_S = 0.5
"""Between two transforms that are interpolated: odometry comes at 2 Hz or faster."""


@dataclass(frozen=True)
class _Link:
    parent: str
    said_by: str
    """Topic."""
    fixed: Pose | None
    """parent_from_child, or None: it moves."""
    moving: CameraPath | None


class FrameTree:
    """For each frame its parent and the transform to it."""

    def __init__(self, links: dict[str, _Link]) -> None:
        self._links = links

    @classmethod
    def of(cls, reader: Any, tf: str, odometry: str) -> FrameTree:
        """The tree of an open bag; `tf` and `odometry`: types of messages. Odometry holds where tf says nothing."""
        fixed: dict[str, _Link] = {}
        moving: dict[tuple[str, bool, str, str], list[tuple[float, Pose]]] = defaultdict(list)
        chosen = [c for c in reader.connections if c.msgtype in (tf, odometry)]
        for connection, _, data in reader.messages(connections=chosen) if chosen else ():
            message = reader.deserialize(data, connection.msgtype)
            for parent, child, time_s, pose in _transforms(message, connection.topic):
                if connection.topic.endswith("tf_static"):
                    fixed[child] = _Link(parent, connection.topic, pose, None)
                else:
                    key = child, connection.msgtype == odometry, connection.topic, parent
                    moving[key].append((time_s, pose))
        links = dict(fixed)
        for child, is_odometry, topic, parent in sorted(moving, reverse=True):  # the last one holds: tf
            stamped = moving[(child, is_odometry, topic, parent)]
            links[child] = _Link(parent, topic, None, CameraPath(stamped, LARGEST_GAP_S))
        return cls(links)

    def world_from(self, frame: str, time_s: float) -> Pose | None:
        """Pose [4, 4] of a frame in the root of its tree; None where it is not known, or nothing on the way moves."""
        pose: Pose = np.eye(4)
        links = self._chain(frame)
        if all(link.moving is None for link in links):
            return None
        for link in links:
            step = link.fixed if link.moving is None else link.moving.at(time_s)
            if step is None:
                return None
            pose = step @ pose
        return pose

    def path_of(self, frame: str) -> str:
        """The frames from the root to this one and who says so, for a note."""
        links = self._chain(frame)
        names = [frame, *(link.parent for link in links)]
        topics = sorted({link.said_by for link in links})
        return f"{' > '.join(reversed(names))} ({', '.join(topics)})"

    def _chain(self, frame: str) -> list[_Link]:
        """From the frame up to its root; a cycle ends where it closes."""
        links, seen = [], {frame}
        while (link := self._links.get(frame)) is not None and link.parent not in seen:
            links.append(link)
            seen.add(link.parent)
            frame = link.parent
        return links


def _transforms(message: Any, topic: str) -> list[tuple[str, str, float, Pose]]:
    """[(parent, child, time_s, parent_from_child)] of a TFMessage or an Odometry."""
    if hasattr(message, "transforms"):
        return [
            (
                t.header.frame_id,
                t.child_frame_id,
                _seconds(t),
                _pose(t.transform.translation, t.transform.rotation, topic),
            )
            for t in message.transforms
        ]
    pose = message.pose.pose
    where = _pose(pose.position, pose.orientation, topic)
    return [(message.header.frame_id, message.child_frame_id, _seconds(message), where)]


def _seconds(message: Any) -> float:
    stamp = message.header.stamp
    return float((stamp.sec * 10**9 + stamp.nanosec) * 1e-9)


def _pose(at: Any, turn: Any, topic: str) -> Pose:
    return from_quaternion(np.array([at.x, at.y, at.z]), np.array([turn.x, turn.y, turn.z, turn.w]), topic)
