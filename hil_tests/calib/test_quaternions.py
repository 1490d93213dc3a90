"""Quaternions beside SciPy's."""

from __future__ import annotations

import numpy as np
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from calib.geometry.rigid import quaternion_of, rotation_of

SAME = 1e-14
HALF_TURNS = [[0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0], [0.0, 0.6, -0.8, 0.0]]


def test_quaternions_are_those_of_scipy_at_every_turn() -> None:
    seeded = Rotation.random(500, random_state=7)
    near_half = np.random.default_rng(8).normal(size=(50, 3))
    near_half *= (np.pi - 1e-9) / np.linalg.norm(near_half, axis=1, keepdims=True)
    for turn in Rotation.concatenate([seeded, Rotation.from_rotvec(near_half), Rotation.identity(1)]):
        assert_allclose(
            quaternion_of(turn.as_matrix()), turn.as_quat(canonical=True, scalar_first=True), atol=SAME
        )
        assert_allclose(rotation_of(turn.as_quat(scalar_first=True)), turn.as_matrix(), atol=SAME)


def test_half_turns_and_lengths_come_back() -> None:
    for quaternion in HALF_TURNS:
        matrix = rotation_of(np.multiply(3.0, quaternion))
        assert_allclose(matrix, Rotation.from_quat(quaternion, scalar_first=True).as_matrix(), atol=SAME)
        assert_allclose(np.abs(np.dot(quaternion_of(matrix), quaternion)), 1.0, atol=SAME)
