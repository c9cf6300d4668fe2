"""The synthetic scenes as sources: frames, poses, truth, options."""

from __future__ import annotations

import numpy as np
import pytest

from client.errors import SourceError
from client.options.source import open_source
from client.synthetic.scenes.hand import LEAVE, capsules
from client.synthetic.sensor_noise import kinect_like
from client.synthetic.source import SyntheticSource, open_synthetic, to_srgb8

SMALL = "size=96x72"
SCENES = ("table", "room", "hand", "light")


def small(name: str, more: str = "") -> SyntheticSource:
    return open_synthetic(f"synthetic:{name}?{SMALL}{more}")


@pytest.mark.parametrize("name", SCENES)
def test_is_a_source(name: str) -> None:
    source = open_source(f"synthetic:{name}?{SMALL}")
    assert (len(source), source.fps, source.has_poses, source.up) == (60, 30.0, True, (0.0, 1.0, 0.0))
    assert (source.camera.width, source.camera.height) == (96, 72)
    frame = source[7]
    assert (frame.index, frame.timestamp_s) == (7, pytest.approx(7 / 30))
    assert (frame.color.shape, frame.color.dtype) == ((72, 96, 3), np.uint8)
    assert (frame.depth.shape, frame.depth.dtype) == ((72, 96), np.uint16)
    with pytest.raises(IndexError):
        source[60]


@pytest.mark.parametrize("name", SCENES)
def test_frame_is_the_truth_in_fewer_bits(name: str) -> None:
    source = small(name)
    frame, truth = source[20], source.truth(20)
    np.testing.assert_array_equal(frame.depth > 0, truth.visible)
    assert np.abs(frame.depth * 0.001 - truth.depth_m).max() <= 0.00051
    np.testing.assert_array_equal(frame.color, to_srgb8(truth.radiance))
    np.testing.assert_allclose(np.linalg.norm(truth.normals[truth.visible], axis=1), 1, atol=1e-5)
    assert not truth.normals[~truth.visible].any()
    assert truth.sh.shape == (16, 3)


@pytest.mark.parametrize("name", SCENES)
def test_same_frame_same_bytes_whatever_came_before(name: str) -> None:
    one, other = small(name, "&noise=1"), small(name, "&noise=1")
    for index in (3, 40, 17):
        one[index]
    np.testing.assert_array_equal(one[25].color, other[25].color)
    np.testing.assert_array_equal(one[25].depth, other[25].depth)


@pytest.mark.parametrize("name", SCENES)
def test_poses_are_rigid_smooth_and_look_at_something(name: str) -> None:
    source = small(name)
    poses = np.array([source.pose(i) for i in range(60)])
    turned = poses[:, :3, :3]
    np.testing.assert_allclose(turned @ turned.transpose(0, 2, 1), np.broadcast_to(np.eye(3), turned.shape), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(turned), 1, atol=1e-12)
    assert turned[:, 1, 1].max() < 0  # y of the camera points down
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    assert 0 < steps.max() < 0.05  # walking pace: 1.5 m/s at most
    np.testing.assert_array_equal(source[5].world_from_camera, source.pose(5))


@pytest.mark.parametrize("name", SCENES)
def test_one_view_carried_onto_another(name: str) -> None:
    """Depth, intrinsics and poses agree: points of one frame have the other's depth, where they are not hidden."""
    source = open_synthetic(f"synthetic:{name}?size=320x240")
    first, second = source.truth(0), source.truth(6)
    v, u = np.nonzero(first.visible & ~first.dynamic)
    camera, z = source.camera, first.depth_m[v, u].astype(float)
    points = np.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z, np.ones_like(z)])
    x, y, z, _ = np.linalg.inv(source.pose(6)) @ source.pose(0) @ points
    x, y = (x / z * camera.fx + camera.cx).round().astype(int), (y / z * camera.fy + camera.cy).round().astype(int)
    inside = (x >= 0) & (x < 320) & (y >= 0) & (y < 240)
    error = np.abs(second.depth_m[y[inside], x[inside]] - z[inside])
    assert inside.sum() > 5000
    assert np.median(error) < 0.003  # half a pixel's slope


@pytest.mark.parametrize("light", range(8))
@pytest.mark.parametrize("name", ["table", "room"])
def test_nothing_clips(name: str, light: int) -> None:
    for texture in (0, 1):
        source = small(name, f"&light={light}&texture={texture}&frames=240")
        for index in (0, 60, 120, 180):
            radiance = source.truth(index).radiance
            assert radiance.max() < 1
            assert radiance.min() > 0


def test_plain_scenes_are_grey_and_textured_ones_are_not() -> None:
    plain, textured = small("table").truth(0), small("table", "&texture=1").truth(0)
    assert (plain.albedo[plain.visible] == 0.5).all()
    assert textured.albedo[textured.visible].std(axis=0).min() > 0.05
    assert textured.albedo[textured.visible].min() > 0.02
    assert textured.albedo.max() <= 0.8
    np.testing.assert_allclose(
        plain.radiance[plain.visible] / 0.5,
        (textured.radiance / np.maximum(textured.albedo, 1e-9))[plain.visible],
        atol=1e-6,
    )


def test_many_normals_on_the_table() -> None:
    truth = small("table").truth(0)
    normals = truth.normals[truth.visible]
    spread = np.linalg.eigvalsh(normals.T @ normals / len(normals))
    assert spread[0] > 0.03  # no direction is without slopes


def test_light_moves_and_says_where() -> None:
    source = small("light", "&frames=240")
    azimuths = [np.arctan2(d[0], d[2]) for d in (source.truth(i).light_direction for i in range(0, 240, 10))]
    steps = np.diff(np.unwrap(azimuths))
    np.testing.assert_allclose(steps, np.radians(15), atol=1e-9)
    first, later = source.truth(0), source.truth(100)
    assert not np.allclose(first.sh, later.sh)
    luminance = later.sh @ [0.2126, 0.7152, 0.0722]
    l1 = luminance[[3, 1, 2]]
    np.testing.assert_allclose(l1 / np.linalg.norm(l1), later.light_direction, atol=1e-12)


def test_light_stands_still_elsewhere() -> None:
    source = small("table", "&light=6")
    np.testing.assert_array_equal(source.truth(0).sh, source.truth(59).sh)


def test_hand_comes_and_goes() -> None:
    source = small("hand")
    share = [source.truth(i).dynamic.mean() for i in range(0, 60, 5)]
    assert share[0] == share[1] == share[-1] == 0
    assert max(share) > 0.02
    assert not small("table").truth(30).dynamic.any()
    before, after = small("table")[0], source[0]
    np.testing.assert_array_equal(before.color, after.color)
    np.testing.assert_array_equal(before.depth, after.depth)


def test_hand_hides_the_table_and_shadows_it() -> None:
    with_hand, without = small("hand").truth(30), small("table").truth(30)
    both = with_hand.visible & without.visible
    nearer = with_hand.dynamic & both
    assert (with_hand.depth_m[nearer] < without.depth_m[nearer]).all()
    still = both & ~with_hand.dynamic
    np.testing.assert_array_equal(with_hand.depth_m[still], without.depth_m[still])
    change = (without.radiance - with_hand.radiance)[still].max(axis=1)
    assert change.min() > -1e-6  # a shadow only takes light away
    assert change.max() > 0.02


def test_hand_hovers_and_waves() -> None:
    stays = [capsules(p) for p in np.linspace(0.36, LEAVE, 20)]
    lowest = min(min(c.start[1], c.end[1]) - c.radius for parts in stays for c in parts)
    assert lowest > 0.05  # its shadow is integrated coarsely because it is soft
    sideways = [parts[0].start[2] for parts in stays]
    assert np.ptp(sideways) > 0.05


def test_noise_is_like_a_sensors() -> None:
    clean, noisy = open_synthetic("synthetic:table")[0].depth, open_synthetic("synthetic:table?noise=1")[0].depth
    assert 0.005 < np.mean(noisy[clean > 0] == 0) < 0.2
    measured = (clean > 0) & (noisy > 0)
    error = noisy[measured].astype(float) - clean[measured]
    assert 0.5 < np.median(np.abs(error)) < 6  # millimetres at about 1.3 m
    assert abs(np.median(error)) < 1


def test_noise_of_a_flat_wall() -> None:
    wall, slant = np.full((200, 200), 2.0), np.ones((200, 200))
    noisy = kinect_like(wall, slant, 525.0, 3)
    assert (noisy > 0).all()
    step = 2.0**2 / (525 * 0.075) / 8  # one disparity step at 2 m
    assert np.abs(noisy - 2).max() < 4 * step
    assert len(np.unique(noisy)) < 10
    assert not np.array_equal(noisy, kinect_like(wall, slant, 525.0, 4))
    assert (kinect_like(wall, np.full((200, 200), 0.05), 525.0, 3) == 0).all()


@pytest.mark.parametrize("way", ["walk", "steps"])
def test_another_exposure_is_another_picture_of_the_same(way: str) -> None:
    """Truth is told in the picture's units; what frames say of it goes as the pictures do."""
    usual, source = small("table"), small("table", f"&exposure={way}")
    relative = [source.exposure(i) for i in range(60)]
    assert relative[0] == 1
    assert min(relative) < 0.6
    assert max(relative) > 1.7
    for index in (0, 20, 50):
        frame, truth, exposure = source[index], source.truth(index), source.exposure(index)
        assert frame.exposure == pytest.approx(source[0].exposure * exposure)
        np.testing.assert_array_equal(frame.color, to_srgb8(truth.radiance))
        np.testing.assert_allclose(truth.radiance, exposure * usual.truth(index).radiance)
        np.testing.assert_allclose(truth.sh, exposure * usual.truth(index).sh)
        np.testing.assert_array_equal(frame.depth, usual[index].depth)


def test_lamps_are_told_in_the_picture_s_units() -> None:
    usual, source = small("lamp").truth(15), small("lamp", "&exposure=steps").truth(15)
    np.testing.assert_allclose(source.lamps[0].intensity, 0.5 * usual.lamps[0].intensity)
    np.testing.assert_allclose(source.lamplight, 0.5 * usual.lamplight)


def test_frames_say_that_their_exposure_is_constant_or_nothing() -> None:
    assert {small("table")[i].exposure for i in (0, 7)} == {1.0}
    assert small("table", "&exposure_given=0")[7].exposure is None
    assert small("table", "&exposure=walk&exposure_given=0")[7].exposure is None


def test_srgb_of_known_values() -> None:
    np.testing.assert_array_equal(
        to_srgb8(np.array([0, 0.0031308, 0.2158605, 0.5, 1.0, 2.0, -1.0])), [0, 10, 128, 188, 255, 255, 0]
    )


@pytest.mark.parametrize(
    ("spec", "words"),
    [
        ("synthetic:moon", "synthetic:table"),
        ("synthetic:", "synthetic:room"),
        ("synthetic:table?speed=3", "'speed'"),
        ("synthetic:table?frames=0", "1 to"),
        ("synthetic:table?frames=ten", "1 to"),
        ("synthetic:table?light=8", "0 to 7"),
        ("synthetic:table?texture=yes", "0 to 1"),
        ("synthetic:table?exposure=auto", "constant, walk, steps"),
        ("synthetic:table?exposure_given=yes", "0 to 1"),
        ("synthetic:table?size=640", "WIDTHxHEIGHT"),
        ("synthetic:table?size=8x8", "WIDTHxHEIGHT"),
        ("synthetic:table?size=1920x1920", "pixels"),
    ],
)
def test_wrong_specs(spec: str, words: str) -> None:
    with pytest.raises(SourceError, match=words) as caught:
        open_source(spec)
    assert "\n" not in str(caught.value)
