"""Arrays of pixels: each pair gives what it gives alone, and a bad one stops no other."""

from __future__ import annotations

import copy
import pickle

import numpy as np
import pytest

from calib.errors import NoStereoPoint
from calib.files.mast_file import load_rig
from calib.geometry.cahvor import CameraModel
from calib.geometry.handoff import Joints, hand_off
from calib.geometry.rig import Rig
from calib.geometry.stereo import Triangulation, triangulate

LAST_BITS = 1e-12
"""Relative: sums of three terms in another order, over the two milliradians under which the rays meet."""


@pytest.fixture(scope="module", params=["rocky8_simulated", "skew8_simulated"])
def rig(request: pytest.FixtureRequest) -> Rig:
    root = request.config.rootpath
    return load_rig(root / "configs" / "masts" / f"{request.param}.yaml").rig


@pytest.fixture(scope="module")
def eyes(rig: Rig) -> tuple[CameraModel, CameraModel]:
    return rig.camera_in_rover("navcam_left", 0.2, -0.3), rig.camera_in_rover("navcam_right", 0.2, -0.3)


def clicks(eyes: tuple[CameraModel, CameraModel], count: int) -> tuple[np.ndarray, np.ndarray]:
    """Pixels of points in front of both eyes, with a third of a pixel of noise."""
    rng = np.random.default_rng(5)
    left, right = eyes
    points = left.ray(rng.uniform(100.0, 700.0, (count, 2)))
    at_m = points.origins_m + rng.uniform(2.0, 20.0, (count, 1)) * points.directions
    return left.project(at_m)[0] + rng.normal(0.0, 0.3, (count, 2)), right.project(at_m)[0]


def test_every_pair_of_pixels_has_the_point_that_it_has_alone(eyes: tuple[CameraModel, CameraModel]) -> None:
    left_px, right_px = clicks(eyes, 100)
    many = triangulate(*eyes, left_px, right_px, 0.3)
    assert (many.refused == "").all()
    for row in range(100):
        alone = triangulate(*eyes, left_px[row], right_px[row], 0.3)
        for name in ("position_m", "covariance_m2", "ranges_m"):
            scale = np.abs(getattr(alone, name)).max()
            np.testing.assert_allclose(
                getattr(many, name)[row], getattr(alone, name), rtol=0, atol=LAST_BITS * scale, err_msg=name
            )
        assert many.ray_gap_m[row] == pytest.approx(alone.ray_gap_m, abs=LAST_BITS * alone.ranges_m[0])


def test_triangulate_takes_arrays_as_project_does(eyes: tuple[CameraModel, CameraModel]) -> None:
    left_px, right_px = clicks(eyes, 6)
    block = triangulate(*eyes, left_px.reshape(2, 3, 2), right_px.reshape(2, 3, 2))
    assert isinstance(block, Triangulation)
    assert block.position_m.shape == (2, 3, 3) and block.covariance_m2.shape == (2, 3, 3, 3)
    assert block.ray_gap_m.shape == block.refused.shape == (2, 3) and block.ranges_m.shape == (2, 3, 2)
    alone = triangulate(*eyes, left_px[5], right_px[5])
    np.testing.assert_allclose(block.position_m[1, 2], alone.position_m, rtol=LAST_BITS)
    nudged = triangulate(*eyes, left_px[0], right_px[0] + np.array([[0.0, 0.0], [0.0, 0.1]]))
    assert isinstance(nudged, Triangulation)
    np.testing.assert_allclose(
        nudged.position_m[1],
        triangulate(*eyes, left_px[0], right_px[0] + [0.0, 0.1]).position_m,
        rtol=LAST_BITS,
    )
    assert alone.position_m.shape == (3,) and alone.ray_gap_m.shape == alone.refused.shape == ()
    nothing = triangulate(*eyes, np.zeros((0, 2)), np.zeros((0, 2)))
    assert isinstance(nothing, Triangulation)
    assert nothing.position_m.shape == (0, 3)


def test_a_bad_pair_of_pixels_stops_no_other() -> None:
    forward, right_hand, down = np.eye(3)
    H, V = 100 * right_hand + 50 * forward, 100 * down + 50 * forward
    left = CameraModel("CAHV", (101, 101), -0.1 * right_hand, forward, H, V)
    right = CameraModel("CAHV", (101, 101), 0.1 * right_hand, forward, H, V)
    many = triangulate(
        left,
        right,
        [[52, 50], [50, 50], [48, 50], [np.nan, 50], [52, 50]],
        [[48, 50], [50, 50], [52, 50], [48, 50], [48, np.inf]],
    )
    assert many.refused.tolist() == ["", "parallel_rays", "behind_camera", "bad_pixel", "bad_pixel"]
    np.testing.assert_allclose(many.position_m[0], [5.0, 0.0, 0.0], atol=1e-12)  # f B / disparity
    for name in ("position_m", "covariance_m2", "ray_gap_m", "ranges_m"):
        array = getattr(many, name)
        assert np.isfinite(array[0]).all() and np.isnan(array[1:]).all(), name


def test_rays_that_meet_behind_one_eye_alone_are_refused() -> None:
    forward, right_hand, down = np.eye(3)
    H, V = 100 * right_hand + 50 * forward, 100 * down + 50 * forward
    ahead = CameraModel("CAHV", (101, 101), np.zeros(3), forward, H, V)
    H, V = -100 * forward + 50 * right_hand, 100 * down + 50 * right_hand
    aside = CameraModel("CAHV", (101, 101), forward + right_hand, right_hand, H, V)  # it looks right
    assert triangulate(ahead, aside, [[50, 50]], [50, 50]).refused.tolist() == ["behind_camera"]
    assert triangulate(aside, ahead, [[50, 50]], [50, 50]).refused.tolist() == ["behind_camera"]


@pytest.mark.parametrize(
    "left_px,right_px,words",
    [
        (np.zeros((4, 3)), np.zeros(2), r"left pixels of shape \(4, 3\) where \(\.\.\., 2\) is expected"),
        (np.zeros((4, 2)), np.zeros((4, 3)), r"right pixels of shape \(4, 3\)"),
        (np.zeros((4, 2)), 1.0, r"right pixels of shape \(\)"),
        (
            np.zeros((4, 2)),
            np.zeros((3, 2)),
            r"\(4, 2\) and right pixels of shape \(3, 2\) do not go together",
        ),
    ],
)
def test_pixels_of_a_wrong_shape_are_refused_by_side(
    eyes: tuple[CameraModel, CameraModel], left_px: np.ndarray, right_px: np.ndarray, words: str
) -> None:
    with pytest.raises(NoStereoPoint, match=words) as refusal:
        triangulate(*eyes, left_px, right_px)
    assert refusal.value.code == "bad_pixel"


def test_what_hands_over_one_target_refuses_the_pixels_of_many(rig: Rig) -> None:
    pair, here = rig.stereo["navcam"], Joints(0.1, -0.6)
    for clicks_px in (([[592.6, 485.5]], [455.3, 494.3]), ([592.6, 485.5], [[455.3, 494.3], [455.3, 494.3]])):
        with pytest.raises(NoStereoPoint, match=r"where \(2,\) is expected") as refusal:
            hand_off(rig, pair, rig.stereo["hazcam"], here, *clicks_px)
        assert refusal.value.code == "bad_pixel"


def test_a_sigma_below_zero_is_refused_for_many_too(eyes: tuple[CameraModel, CameraModel]) -> None:
    with pytest.raises(ValueError, match="sigma_px is -1"):
        triangulate(*eyes, np.zeros((2, 2)), np.zeros((2, 2)), -1.0)


def test_results_are_read_only_and_stay_so(eyes: tuple[CameraModel, CameraModel]) -> None:
    seen = triangulate(*eyes, *clicks(eyes, 2))
    for again in (seen, copy.deepcopy(seen), pickle.loads(pickle.dumps(seen))):
        for name, array in vars(again).items():
            assert not array.flags.writeable, name
