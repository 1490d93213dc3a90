"""Bricks of the simulated world: boxes where they are said to be, closed, met where a box is met."""

from __future__ import annotations

import numpy as np
import pytest

from drivers.errors import BadOptions
from drivers.sim import rocks
from drivers.sim.scene import Scene, SceneSettings

EYE_M = np.array([0.4, -0.1, -1.5])


@pytest.fixture(scope="module")
def bricked(scene: Scene) -> Scene:
    """The common scene with bricks put in; its shadows are left as they are."""
    laid = rocks.scattered(6, np.random.default_rng(5), scene.world.rocks.spheres_m, scene.ground_z_m)
    together = rocks.together(scene.world.rocks, rocks.meshes(laid))
    return Scene(scene.settings, scene.world._replace(rocks=together), laid)


def box_m(origin: np.ndarray, direction: np.ndarray, corners_m: np.ndarray) -> float:
    """Distance along a ray to a box, by slabs in the frame of its edges."""
    edges = corners_m[[1, 3, 4]] - corners_m[0]
    lengths = np.linalg.norm(edges, axis=1)
    axes = edges / lengths[:, None]
    start, along = axes @ (origin - corners_m[0]), axes @ direction
    with np.errstate(divide="ignore"):
        ends = np.sort(np.stack([-start / along, (lengths - start) / along]), axis=0)
    near, far = ends[0].max(), ends[1].min()
    return float(near) if 0 < near <= far else np.inf


def test_bricks_are_boxes_of_their_size_on_the_ground(bricked: Scene) -> None:
    assert len(bricked.bricks) == 6
    for brick in bricked.bricks:
        edges = brick.corners_m[[1, 3, 4]] - brick.corners_m[0]
        assert sorted(np.linalg.norm(edges, axis=1)) == pytest.approx(sorted(rocks.BRICK_SIZE_M))
        np.testing.assert_allclose(edges @ edges.T, np.diag(np.diag(edges @ edges.T)), atol=1e-12)
        assert (brick.corners_m[:4, 2] < brick.corners_m[4:, 2]).all(), "the first four are the upper ones"
        for x, y, z in brick.corners_m[4:]:
            assert z > bricked.ground_z_m(x, y), "no gap under it"
        middle = brick.corners_m.mean(axis=0)
        assert np.linalg.norm(brick.faces_m - middle, axis=1).max() < 0.2


def test_a_brick_is_a_closed_mesh_with_outward_normals(bricked: Scene) -> None:
    mesh = rocks.meshes(bricked.bricks)
    for corners, normals in zip(mesh.corners_m, mesh.normals, strict=True):
        keys = np.unique(np.rint(corners.reshape(-1, 3) * 1e7), axis=0, return_inverse=True)[1].reshape(-1, 3)
        edges = np.concatenate([keys[:, [0, 1]], keys[:, [1, 2]], keys[:, [2, 0]]])
        forward = {(int(a), int(b)) for a, b in edges}
        assert len(forward) == len(edges) and all((b, a) in forward for a, b in forward)
        away = corners.mean(axis=1) - corners.mean(axis=(0, 1))
        assert (np.einsum("ij,ij->i", away, normals[:, 0]) > 0.05).all()


def test_bricks_are_met_where_boxes_are(bricked: Scene) -> None:
    rng = np.random.default_rng(6)
    met = 0
    for brick in bricked.bricks:
        aims = brick.corners_m.mean(axis=0) + rng.uniform(-0.25, 0.25, (40, 3))
        directions = (aims - EYE_M) / np.linalg.norm(aims - EYE_M, axis=1, keepdims=True)
        for direction, range_m in zip(directions, bricked.cast(EYE_M, directions), strict=True):
            expected_m = min(box_m(EYE_M, direction, one.corners_m) for one in bricked.bricks)
            if expected_m < range_m + 1e-6 and np.isfinite(expected_m):
                assert range_m == pytest.approx(expected_m, abs=1e-9)
                met += 1
            else:  # ground or a rock before the brick, or no brick at all
                assert range_m < expected_m
    assert met > 80


def test_a_wrong_number_of_bricks_is_refused() -> None:
    with pytest.raises(BadOptions, match="bricks 25 is not between 0 and 24"):
        SceneSettings(bricks=25)
