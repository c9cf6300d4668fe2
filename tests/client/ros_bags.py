"""ROS 2 bags of a synthetic scene, written by rosbags."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from tests.client.captures import Scene, quaternion

OPTICAL = "camera_color_optical_frame"
BODY_FROM_OPTICAL = np.array([[0, 0, 1, 0.1], [-1, 0, 0, 0.02], [0, -1, 0, 0.3], [0, 0, 0, 1.0]])
"""The camera looks along +x of its robot, REP 103."""


def ros_bag(
    folder: Path,
    scene: Scene,
    *,
    storage: Literal["mcap", "sqlite3"] = "mcap",
    path: Literal["tf", "odometry", "none"] = "tf",
    depth: Literal["16UC1", "32FC1"] = "16UC1",
    depth_frame: str = OPTICAL,
    info: bool = True,
    picture: str = "image_raw",
    distortion: float = 0.0,
) -> Path:
    """A bag with a colour, its camera_info, an aligned depth, and the path of the robot that carries the camera."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    make = _Messages(store, scene)
    plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
    with Writer(folder, version=9, storage_plugin=plugin) as writer:

        def add(topic: str, kind: str) -> Any:
            return writer.add_connection(topic, kind, typestore=store)

        def write(connection: Any, time_ns: int, message: Any) -> None:
            writer.write(connection, time_ns, store.serialize_cdr(message, connection.msgtype))

        color = add(f"/camera/color/{picture}", "sensor_msgs/msg/Image")
        aligned = add("/camera/aligned_depth_to_color/image_raw", "sensor_msgs/msg/Image")
        camera_info = add("/camera/color/camera_info", "sensor_msgs/msg/CameraInfo") if info else None
        static = add("/tf_static", "tf2_msgs/msg/TFMessage")
        moving = add("/tf", "tf2_msgs/msg/TFMessage") if path == "tf" else None
        odometry = add("/odom", "nav_msgs/msg/Odometry") if path == "odometry" else None
        start_ns = round(scene.times_s[0] * 1e9)
        write(static, start_ns - 5, make.tf(start_ns, "base_link", OPTICAL, BODY_FROM_OPTICAL))
        for i, frame in enumerate(scene.frames):
            at = round(scene.times_s[i] * 1e9)
            body = scene.pose(i) @ np.linalg.inv(BODY_FROM_OPTICAL)
            if moving is not None:
                write(moving, at + 1, make.tf(at, "odom", "base_link", body))
            if odometry is not None:
                write(odometry, at + 1, make.odometry(at, body))
            if camera_info is not None:
                write(camera_info, at + 2, make.info(at, distortion))
            write(color, at + 3, make.image(at, OPTICAL, "bgr8", frame.color[..., ::-1]))
            values = frame.depth if depth == "16UC1" else frame.depth.astype(np.float32) / 1000
            write(aligned, at + 4, make.image(at + 3_000_000, depth_frame, depth, values))
    return folder


class _Messages:
    """Messages of one type store."""

    def __init__(self, store: Any, scene: Scene) -> None:
        self._types = store.types
        self._camera = scene.camera

    def image(self, at_ns: int, frame: str, encoding: str, pixels: NDArray[Any]) -> Any:
        """With rows that are four bytes longer than their pixels."""
        height, width = pixels.shape[:2]
        rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(height, -1)
        padded = np.pad(rows, ((0, 0), (0, 4)))
        image = self._types["sensor_msgs/msg/Image"]
        header = self._header(at_ns, frame)
        return image(header, height, width, encoding, 0, padded.shape[1], padded.ravel())

    def info(self, at_ns: int, k1: float) -> Any:
        """K is of the raw picture: with distortion it is not that of the rectified one, P."""
        camera = self._camera
        region = self._types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
        k = np.array([camera.fx + 9 * k1, 0, camera.cx, 0, camera.fy, camera.cy, 0, 0, 1])
        p = np.array([camera.fx, 0, camera.cx, 0, 0, camera.fy, camera.cy, 0, 0, 0, 1, 0])
        return self._types["sensor_msgs/msg/CameraInfo"](
            *(self._header(at_ns, OPTICAL), camera.height, camera.width, "plumb_bob", np.array([k1, 0, 0, 0, 0]), k),
            *(np.eye(3).ravel(), p, 0, 0, region),
        )

    def tf(self, at_ns: int, parent: str, child: str, pose: NDArray[np.float64]) -> Any:
        vector, turn = self._types["geometry_msgs/msg/Vector3"], self._types["geometry_msgs/msg/Quaternion"]
        transform = self._types["geometry_msgs/msg/Transform"](vector(*pose[:3, 3]), turn(*quaternion(pose)))
        stamped = self._types["geometry_msgs/msg/TransformStamped"](self._header(at_ns, parent), child, transform)
        return self._types["tf2_msgs/msg/TFMessage"]([stamped])

    def odometry(self, at_ns: int, pose: NDArray[np.float64]) -> Any:
        types, unknown = self._types, np.zeros(36)
        at = types["geometry_msgs/msg/Point"](*pose[:3, 3])
        place = types["geometry_msgs/msg/Pose"](at, types["geometry_msgs/msg/Quaternion"](*quaternion(pose)))
        still = types["geometry_msgs/msg/Vector3"](0, 0, 0)
        speed = types["geometry_msgs/msg/TwistWithCovariance"](types["geometry_msgs/msg/Twist"](still, still), unknown)
        with_spread = types["geometry_msgs/msg/PoseWithCovariance"](place, unknown)
        return types["nav_msgs/msg/Odometry"](self._header(at_ns, "odom"), "base_link", with_spread, speed)

    def _header(self, at_ns: int, frame: str) -> Any:
        stamp = self._types["builtin_interfaces/msg/Time"](at_ns // 10**9, at_ns % 10**9)
        return self._types["std_msgs/msg/Header"](stamp, frame)
