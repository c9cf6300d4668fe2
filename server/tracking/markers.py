"""Pose of square fiducial markers (ArUco, AprilTag) relative to a camera."""

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
LEAST_POINTS = 24
"""Least number of depth samples on the marker to fit a plane."""
GREATEST_MISFIT = 0.1
"""Greatest relative difference between the sides on that plane and the marker's; beyond it the depth is of another
surface."""


def find_marker(
    gray: NDArray[np.uint8], camera: CameraModel, marker: Marker, depth_m: NDArray[np.float32] | None = None
) -> Floats:
    """camera_from_marker [4, 4], metres: x right and y up on the sheet, z out of it, origin in its middle.

    gray: [h, w], distorted as the camera's. depth_m: [h, w] rectified, 0 = none; improves the orientation, which four
    corners seen from the front fix badly. Raises ValueError, one line, unless the marker is seen exactly once.
    """
    detector = cv2.aruco.ArucoDetector(
        cv2.aruco.getPredefinedDictionary(DICTIONARIES[marker.dictionary]), _sharp_corners()
    )
    seen, ids, _ = detector.detectMarkers(gray)
    found = [] if ids is None else [c for c, i in zip(seen, ids.ravel(), strict=True) if i == marker.id]
    if len(found) != 1:
        raise ValueError(f"marker {marker.id} is seen {len(found)} times, must be once")
    corners = found[0].reshape(4, 2).astype(np.float64)
    on_plane = None if depth_m is None else _corners_on_depth(corners, camera, depth_m)
    if on_plane is not None:
        sides = np.linalg.norm(on_plane - np.roll(on_plane, 1, axis=0), axis=1)
        if np.abs(sides / marker.side_m - 1.0).max() < GREATEST_MISFIT:
            return _fitted(_square(marker), on_plane)
    return _by_corners(corners, camera, marker)


def _square(marker: Marker) -> Floats:
    half = marker.side_m / 2
    return np.array([[-half, half, 0.0], [half, half, 0.0], [half, -half, 0.0], [-half, -half, 0.0]])


def _by_corners(corners: Floats, camera: CameraModel, marker: Marker) -> Floats:
    lens, distortion = _lens(camera)
    solved, rotation, shift = cv2.solvePnP(_square(marker), corners, lens, distortion, flags=cv2.SOLVEPNP_IPPE_SQUARE)
    if not solved:
        raise ValueError(f"the pose of marker {marker.id} is not found")
    camera_from_marker = np.eye(4)
    camera_from_marker[:3, :3] = cv2.Rodrigues(rotation)[0]
    camera_from_marker[:3, 3] = np.asarray(shift, np.float64).ravel()
    return camera_from_marker


def _corners_on_depth(corners: Floats, camera: CameraModel, depth_m: NDArray[np.float32]) -> Floats | None:
    """[4, 3] camera axes: where the corners' rays meet the plane of the depth between them; None: no plane."""
    inside = cv2.fillConvexPoly(np.zeros(depth_m.shape, np.uint8), np.rint(corners).astype(np.int32), 1) > 0
    rows, columns = np.nonzero(inside & (depth_m > 0))
    if len(rows) < LEAST_POINTS:
        return None
    points = depth_m[rows, columns, None] * _rays(np.column_stack([columns, rows]).astype(np.float64), camera)
    middle = np.median(points, axis=0)
    near = points[np.linalg.norm(points - middle, axis=1) < 2 * np.median(np.linalg.norm(points - middle, axis=1))]
    center = near.mean(axis=0)
    normal = np.linalg.svd(near - center, full_matrices=False)[2][2]
    rays = _rays(corners, camera)
    facing = rays @ normal
    if np.abs(facing).min() < 0.05:
        return None
    return np.asarray((center @ normal / facing)[:, None] * rays)


def _rays(pixels: Floats, camera: CameraModel) -> Floats:
    """[n, 3] rays with z = 1."""
    flat = cv2.undistortPoints(pixels[:, None], *_lens(camera))[:, 0]
    return np.column_stack([flat, np.ones(len(flat))]).astype(np.float64)


def _lens(camera: CameraModel) -> tuple[Floats, Floats]:
    matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    return matrix, np.array(camera.distortion, np.float64)


def _fitted(points: Floats, places: Floats) -> Floats:
    """Rigid [4, 4] that maps `points` [n, 3] to `places` [n, 3] with least squared error (Kabsch)."""
    from_middle, to_middle = points.mean(axis=0), places.mean(axis=0)
    u, _, vt = np.linalg.svd((places - to_middle).T @ (points - from_middle))
    rotation = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, to_middle - rotation @ from_middle
    return matrix


def _sharp_corners() -> cv2.aruco.DetectorParameters:
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    return parameters
