"""Quaternions against SciPy, and the checks on what a file says."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from client.errors import SourceError
from client.sources.poses import quaternion, read_tum, rigid


def test_quaternion_against_scipy() -> None:
    rotations = Rotation.random(500, rng=np.random.default_rng(1))
    half_turns = Rotation.from_rotvec(np.pi * np.eye(3))
    for rotation in (*rotations, *half_turns, Rotation.identity()):
        matrix = rotation.as_matrix()
        ours = quaternion(matrix)
        assert np.linalg.norm(ours) == pytest.approx(1, abs=1e-12)
        np.testing.assert_allclose(Rotation.from_quat(ours).as_matrix(), matrix, atol=1e-12)
        assert ours[3] >= 0 or abs(ours[3]) < 1e-12


def test_tum_lines_against_scipy(tmp_path) -> None:
    rotations = Rotation.random(20, rng=np.random.default_rng(2))
    lines = [
        f"{i} {i} 2 3 {x} {y} {z} {w}  # note" for i, (x, y, z, w) in enumerate(rotations.as_quat(canonical=False))
    ]
    path = tmp_path / "poses.txt"
    path.write_text("# timestamp tx ty tz qx qy qz qw\n\n" + "\n".join(lines))
    poses = read_tum(path)
    assert [time_s for time_s, _ in poses] == list(range(20))
    np.testing.assert_allclose([pose[:3, :3] for _, pose in poses], rotations.as_matrix(), atol=1e-12)
    np.testing.assert_array_equal(poses[7][1][:3, 3], (7, 2, 3))


def test_rounded_rotation_becomes_exact() -> None:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("xyz", (0.3, -0.5, 1.1)).as_matrix().round(3)
    repaired = rigid(pose, "here")[:3, :3]
    np.testing.assert_allclose(repaired.T @ repaired, np.eye(3), atol=1e-14)
    assert np.abs(repaired - pose[:3, :3]).max() < 1e-3


def test_what_is_refused(tmp_path) -> None:
    with pytest.raises(SourceError, match="here: the pose has NaN"):
        rigid(np.full((4, 4), np.nan), "here")
    mirrored = np.diag([1.0, 1, -1, 1])
    with pytest.raises(SourceError, match="not a rotation"):
        rigid(mirrored, "here")
    path = tmp_path / "poses.txt"
    path.write_text("0 0 0 0 0 0 0\n")
    with pytest.raises(SourceError, match="line 1"):
        read_tum(path)
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(SourceError, match="not a text file"):
        read_tum(path)
