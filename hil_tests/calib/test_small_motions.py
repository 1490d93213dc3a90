"""One order for the six numbers of a small motion: a turn, then a shift; truth is SciPy's rotation."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from calib.geometry.rigid import Rigid, carried_covariance, moved_rigid, rigid_rates

STEP = np.array([0.3, -0.2, 0.5, 1.0, 2.0, -3.0])
POSE = Rigid(Rotation.from_rotvec([0.4, 1.1, -0.7]).as_matrix(), np.array([0.2, -1.4, 0.9]))
POINTS_M = np.array([[1.0, 2.0, 3.0], [-0.5, 0.1, 4.0]])
SMALL = 1e-6


def test_a_step_turns_a_pose_about_its_own_origin_and_then_shifts_it() -> None:
    moved = moved_rigid(POSE, STEP)
    turn = Rotation.from_rotvec(STEP[:3])
    wanted = turn.apply(POSE.vectors(POINTS_M)) + POSE.translation_m + STEP[3:]
    np.testing.assert_allclose(moved.points(POINTS_M), wanted, atol=1e-14)


def test_rates_of_points_are_differences_of_steps() -> None:
    rates = rigid_rates(np.eye(3)[None], POSE.points(POINTS_M), POSE.translation_m)
    for i, unit in enumerate(SMALL * np.eye(6)):
        ends = [moved_rigid(POSE, sign * unit).points(POINTS_M) for sign in (1.0, -1.0)]
        np.testing.assert_allclose(rates[:, :, i], (ends[0] - ends[1]) / (2 * SMALL), atol=1e-8)


def test_rates_of_something_per_point_follow_those_of_the_points() -> None:
    per_point = np.arange(12.0).reshape(2, 2, 3)
    of_points = rigid_rates(np.eye(3)[None], POINTS_M, POSE.translation_m)
    np.testing.assert_allclose(
        rigid_rates(per_point, POINTS_M, POSE.translation_m), per_point @ of_points, atol=1e-12
    )


def test_a_carried_covariance_moves_carried_points_as_the_steps_do() -> None:
    """About the origin of the frame, here and there."""
    for unit in np.eye(6):
        turned = Rotation.from_rotvec(SMALL * unit[:3])
        moves = POSE.points(turned.apply(POINTS_M) + SMALL * unit[3:]) - POSE.points(POINTS_M)
        carried = carried_covariance(np.outer(unit, unit), POSE)
        rates = rigid_rates(np.eye(3)[None], POSE.points(POINTS_M), np.zeros(3))
        spread = np.einsum("nip,pq,njq->nij", rates, carried, rates)
        np.testing.assert_allclose(spread, np.einsum("ni,nj->nij", moves, moves) / SMALL**2, atol=1e-4)
