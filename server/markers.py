"""Square fiducial markers (ArUco, AprilTag): where one stands before a camera."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from protocol.frames import CameraModel
from protocol.messages import Marker

Floats = NDArray[np.float64]

DICTIONARIES = {
    "4x4_50": cv2.aruco.DICT_4X4_50,
    "5x5_100": cv2.aruco.DICT_5X5_100,
    "6x6_250": cv2.aruco.DICT_6X6_250,
    "7x7_1000": cv2.aruco.DICT_7X7_1000,
    "apriltag_36h11": cv2.aruco.DICT_APRILTAG_36h11,
}


def find_marker(gray: NDArray[np.uint8], camera: CameraModel, marker: Marker) -> Floats:
    """camera_from_marker [4, 4], metres: x right and y up on the sheet, z out of it, origin in its middle.

    gray: [h, w] as the camera took it. Raises ValueError, one line, where it is not seen just once.
    """
    detector = cv2.aruco.ArucoDetector(
        cv2.aruco.getPredefinedDictionary(DICTIONARIES[marker.dictionary]), _sharp_corners()
    )
    corners, ids, _ = detector.detectMarkers(gray)
    found = [] if ids is None else [c for c, i in zip(corners, ids.ravel(), strict=True) if i == marker.id]
    if len(found) != 1:
        raise ValueError(f"marker {marker.id} is seen {len(found)} times, must be once")
    half = marker.side_m / 2
    square = np.array([[-half, half, 0], [half, half, 0], [half, -half, 0], [-half, -half, 0]])
    lens = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    solved, turn, shift = cv2.solvePnP(
        square,
        found[0].reshape(4, 2).astype(np.float64),
        lens,
        np.array(camera.distortion, np.float64),
        flags=cv2.SOLVEPNP_IPPE_SQUARE,
    )
    if not solved:
        raise ValueError(f"the pose of marker {marker.id} is not found")
    camera_from_marker = np.eye(4)
    camera_from_marker[:3, :3] = cv2.Rodrigues(turn)[0]
    camera_from_marker[:3, 3] = np.asarray(shift, np.float64).ravel()
    return camera_from_marker


def _sharp_corners() -> cv2.aruco.DetectorParameters:
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    return parameters
