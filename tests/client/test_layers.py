"""Layers on the client's side: what is refused, what is mixed, and where another camera sees it."""

from __future__ import annotations

from typing import Any

import cv2
import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray

from client.display.layers import NEUTRAL, DecodedLayer, decode_layer, put_over, shown_picture
from protocol.codec import ProtocolError
from protocol.frames import CameraModel
from protocol.images import encode_depth
from protocol.messages import ColorImage, Layer, LayerPatch, Plan, Timings

CAMERA = CameraModel(width=160, height=120, fx=150.0, fy=140.0, cx=81.0, cy=57.5)
POSE = np.array([[0, -1, 0, 0.125], [1, 0, 0, 0.1], [0, 0, 1, -2.5], [0, 0, 0, 1]], np.float64)
PICTURE = np.random.default_rng(3).integers(0, 256, (120, 160, 3), np.uint8)

Codes = NDArray[np.uint8]
Floats = NDArray[np.float64]


def patch(x: int, y: int, color: Codes, depth_m: float | Floats, codec: str = "zdelta") -> LayerPatch:
    height, width = color.shape[:2]
    units = np.rint(1000 * np.broadcast_to(depth_m, (height, width))).astype(np.uint16)
    order = cv2.COLOR_RGBA2BGRA if color.shape[2] == 4 else cv2.COLOR_RGB2BGR
    png = cv2.imencode(".png", cv2.cvtColor(color, order))[1].tobytes()
    image = ColorImage(width=width, height=height, codec="png", data=png)
    return LayerPatch(x=x, y=y, color=image, depth=encode_depth(units, codec))


def message(**parts: Any) -> Layer:
    fields = {"virtual": None, "ratio": None, "world_from_camera": tuple(POSE.ravel().tolist()), **parts}
    rest = {"tracking": "given", "timings": Timings(), "plan": Plan(run=(), left_out=())}
    return Layer(frame=0, timestamp_s=0.0, depth_scale_m=0.001, **fields, **rest)


def read(**parts: Any) -> DecodedLayer:
    return decode_layer(message(**parts), CAMERA)


def moved(x_m: float = 0.0, z_m: float = 0.0, turned_deg: float = 0.0) -> Floats:
    """World from a camera that has moved by its own axes, and turned about its vertical."""
    angle, step = np.radians(turned_deg), np.eye(4)
    step[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    step[:3, 3] = x_m, 0, z_m
    return POSE @ step


def full(code: int, alpha: int = 255, height: int = 30, width: int = 40) -> Codes:
    return np.dstack([np.full((height, width, 3), code, np.uint8), np.full((height, width), alpha, np.uint8)])


def covered(layer: DecodedLayer, pose: Floats | None) -> NDArray[np.bool_]:
    """[h, w] where a layer of white is seen over black."""
    return put_over(layer, np.zeros_like(PICTURE), CAMERA, pose).max(-1) > 127


# ---- mixing ------------------------------------------------------------------------------------------------------


def test_nothing_changes_nothing() -> None:
    for pose in (None, POSE, moved(0.1)):
        np.testing.assert_array_equal(put_over(read(), PICTURE, CAMERA, pose), PICTURE)


def test_layers_are_mixed_in_linear_light() -> None:
    half = np.full((20, 20, 3), 91, np.uint8)  # (91 / 128)^2 is 0.505
    layer = read(virtual=patch(10, 10, full(255, 128, 20, 20), 1.0), ratio=patch(10, 10, half, 1.0))
    picture = put_over(layer, np.full_like(PICTURE, 255), CAMERA)
    # 128 / 255 of white and the rest of half of white: 0.754, which is code 225; half of white alone is 188.
    assert set(picture[10:30, 10:30].ravel()) == {225}
    assert set(
        put_over(read(ratio=patch(10, 10, half, 1.0)), np.full_like(PICTURE, 255), CAMERA)[10:30, 10:30].ravel()
    ) == {188}
    assert set(np.delete(picture.reshape(120, 160, 3), slice(10, 30), axis=0).ravel()) == {255}


def test_neutral_ratios_and_what_covers_nothing_leave_every_code() -> None:
    every = np.resize(np.arange(256, dtype=np.uint8), PICTURE.shape)
    neutral = np.full((30, 40, 3), NEUTRAL, np.uint8)
    layer = read(virtual=patch(3, 5, full(200, 0), 1.0), ratio=patch(3, 5, neutral, 1.0))
    np.testing.assert_array_equal(put_over(layer, every, CAMERA), every)


# ---- as another camera sees it -----------------------------------------------------------------------------------


@pytest.mark.parametrize("pose", [moved(0.05), moved(z_m=0.2), moved(turned_deg=9.0), moved(0.05, -0.1, -7.0)])
def test_a_plane_is_seen_by_its_homography(pose: Floats) -> None:
    """Against OpenCV's warp of the same picture: 30 by 40 pixels of stripes on a plane 0.8 m away."""
    stripes = full(255)
    stripes[:, 20:, :3] = 60
    layer = read(virtual=patch(60, 40, stripes, 0.8))
    matrix = np.array([[CAMERA.fx, 0, CAMERA.cx], [0, CAMERA.fy, CAMERA.cy], [0, 0, 1]])
    camera_from_layer = np.linalg.inv(pose) @ POSE
    turn, shift = camera_from_layer[:3, :3], camera_from_layer[:3, 3:]
    homography = matrix @ (turn + shift @ np.array([[0, 0, 1 / 0.8]])) @ np.linalg.inv(matrix)
    ground = np.zeros_like(PICTURE)
    ground[40:70, 60:100] = stripes[..., :3]
    expected = cv2.warpPerspective(ground, homography, (160, 120))
    found = put_over(layer, np.zeros_like(PICTURE), CAMERA, pose)
    is_inside = cv2.erode((expected > 30).all(-1).astype(np.uint8), np.ones((3, 3))) > 0
    edges = cv2.dilate(
        (np.abs(np.gradient(expected.astype(float)[..., 0])).max(0) > 2).astype(np.uint8), np.ones((3, 3))
    )
    is_sure = is_inside & (edges == 0)
    assert is_sure.sum() > 500
    assert np.abs(found.astype(int) - expected)[is_sure].max() <= 1
    outline = [(picture > 30).all(-1) for picture in (found, expected)]
    assert (outline[0] != outline[1]).sum() <= 2 * (30 + 40)  # a pixel's width, all around
    assert (outline[0] & outline[1]).sum() > 0.9 * outline[1].sum()


def test_the_nearer_of_two_surfaces_is_seen() -> None:
    """Two halves, white 0.5 m and grey 1 m away: as the camera moves to the right, the white one covers the other."""
    halves = full(255)
    halves[:, 20:, :3] = 100
    depth_m = np.where(np.arange(40) < 20, 0.5, 1.0)
    layer = read(virtual=patch(60, 40, halves, depth_m))
    picture = put_over(layer, np.zeros_like(PICTURE), CAMERA, moved(-0.04))[55]
    # The near half is seen 0.04 m * 150 / 0.5 m = 12 px to the right, the far one 6 px.
    assert set(picture[73:91].ravel()) == {255}
    assert set(picture[93:105].ravel()) == {100}
    apart = put_over(layer, np.zeros_like(PICTURE), CAMERA, moved(0.04))[55]
    assert set(apart[49:67].ravel()) == {255}
    assert set(apart[69:73].ravel()) == {0}  # what was hidden before is nothing, not drawn out between the two
    assert set(apart[75:93].ravel()) == {100}


def test_far_surface_is_not_torn_between_the_steps_of_its_depth() -> None:
    """A floor 15 to 45 m away, in steps of 1 / 400 of its inverse: more than JUMP each, from 20 m on."""
    inverse = np.rint(400 * np.broadcast_to(np.linspace(1 / 45, 1 / 15, 30)[:, None], (30, 40))) / 400
    layer = read(virtual=patch(60, 40, full(255), 1 / inverse))
    for up_m in (-2.0, 2.0):  # so far that gaps between steps would be half a pixel wide
        step = np.eye(4)
        step[1, 3] = up_m
        seen = covered(layer, POSE @ step)
        rows, columns = np.nonzero(seen)
        assert seen.sum() > 600
        for row in np.unique(rows):  # no pixel is missing between the first and the last
            assert seen[row, columns[rows == row].min() : columns[rows == row].max() + 1].all()
        assert (np.diff(np.unique(rows)) == 1).all()


def test_what_is_behind_the_camera_is_not_seen() -> None:
    layer = read(virtual=patch(60, 40, full(255), 0.5))
    assert covered(layer, moved(z_m=0.45)).mean() > 0.9  # 5 cm before the camera
    assert not covered(layer, moved(z_m=0.51)).any()
    assert not covered(layer, moved(turned_deg=180.0)).any()


def test_pixels_without_a_depth_are_not_seen_elsewhere() -> None:
    depth_m = np.full((30, 40), 0.8)
    depth_m[:, :20] = 0
    colors = full(255)
    colors[:, :20, 3] = 0
    layer = read(virtual=patch(60, 40, colors, depth_m))
    assert covered(layer, None).sum() == 30 * 20
    assert abs(int(covered(layer, moved(turned_deg=3.0)).sum()) - 30 * 20) < 60


def test_a_shadow_moves_with_its_floor() -> None:
    """A floor seen from above at a slant: its shadow is where the plane is, in each of two views."""
    v = np.mgrid[:120, :160][0].astype(float)
    slant = 1 / (1.0 + 0.6 * (v - CAMERA.cy) / CAMERA.fy)  # of the plane z + 0.6 y = 1
    dark = np.full((120, 160, 3), NEUTRAL, np.uint8)
    dark[70:90, 60:100] = NEUTRAL // 2
    layer = read(ratio=patch(0, 0, dark, slant))
    white = np.full_like(PICTURE, 255)
    pose = moved(0.06, turned_deg=5.0)
    found = put_over(layer, white, CAMERA, pose).min(-1) < 220
    corners = np.array([[59.5, 69.5], [99.5, 69.5], [99.5, 89.5], [59.5, 89.5]])
    rays = np.column_stack([(corners - [CAMERA.cx, CAMERA.cy]) / [CAMERA.fx, CAMERA.fy], np.ones(4)])
    points = rays / (rays @ [0, 0.6, 1.0])[:, None]
    there = np.column_stack([points, np.ones(4)]) @ (np.linalg.inv(pose) @ POSE).T
    seen = there[:, :2] / there[:, 2:3] * [CAMERA.fx, CAMERA.fy] + [CAMERA.cx, CAMERA.cy]
    expected = np.zeros((120, 160), np.uint8)
    cv2.fillConvexPoly(expected, np.rint(seen).astype(np.int32), 1)
    assert (found & (expected > 0)).sum() / (found | (expected > 0)).sum() > 0.9


# ---- reading -----------------------------------------------------------------------------------------------------

SMALL = full(9, height=5, width=7)


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"x": 154}, "beyond the camera's picture"),
        ({"color": patch(0, 0, SMALL[..., :3].copy(), 1.0).color}, "no PNG of 4 channels"),
        ({"color": msgspec.structs.replace(patch(0, 0, SMALL, 1.0).color, width=8)}, "size that both declare"),
        ({"color": patch(0, 0, SMALL[:4], 1.0).color}, "size that both declare"),
        ({"color": msgspec.structs.replace(patch(0, 0, SMALL, 1.0).color, data=b"no png")}, "PNG"),
        ({"color": msgspec.structs.replace(patch(0, 0, SMALL, 1.0).color, codec="jpeg")}, "must be a PNG"),
        ({"depth": msgspec.structs.replace(patch(0, 0, SMALL, 1.0).depth, data=b"xx")}, "depth.data"),
        ({"depth": msgspec.structs.replace(patch(0, 0, SMALL, 1.0, "raw").depth, data=b"xx")}, "needs 70"),
    ],
)
def test_what_is_not_what_it_declares_is_refused(wrong: dict[str, Any], said: str) -> None:
    with pytest.raises(ProtocolError, match=said):
        read(virtual=msgspec.structs.replace(patch(0, 0, SMALL, 1.0), **wrong))


@pytest.mark.parametrize("codec", ["raw", "zdelta", "zstd-delta"])
def test_depth_is_read_by_every_codec(codec: str) -> None:
    depth_m = np.linspace(0.3, 4.0, 35).reshape(5, 7)
    part = read(virtual=patch(2, 3, SMALL, depth_m, codec)).virtual
    assert part is not None
    np.testing.assert_allclose(part.depth_m, depth_m, atol=0.0005)


# ---- what layers are put over ------------------------------------------------------------------------------------


def test_a_plain_picture_is_itself() -> None:
    np.testing.assert_array_equal(shown_picture(PICTURE, CAMERA), PICTURE)


def test_a_linear_picture_is_encoded() -> None:
    linear = np.array([[[0, 13107, 65535]]], np.uint16)  # 0, 0.2 and 1
    camera = msgspec.structs.replace(CAMERA, color_encoding="linear16")
    assert shown_picture(linear, camera).tolist() == [[[0, 124, 255]]]
