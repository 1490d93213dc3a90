"""Arrays of targets and pixels: each gives what it gives alone, and a bad one stops no other."""

from __future__ import annotations

import copy
import pickle

import numpy as np
import pytest

from calib.errors import NoStereoPoint, Unreachable
from calib.files.mast_file import load_rig
from calib.geometry.cahvor import CameraModel
from calib.geometry.handoff import Joints, hand_off
from calib.geometry.pointing import solve, solve_many
from calib.geometry.rig import Mast, Rig
from calib.geometry.solutions import Solution, Solutions, choose
from calib.geometry.stereo import Triangulation, triangulate, triangulate_many

LAST_BITS = 1e-12
"""Relative: sums of three terms in another order, over the two milliradians under which the rays meet."""


SAME = 1e-8
"""Radians and metres: where two solutions nearly meet, the last bit of a ray counts so much."""


def numbers(solutions: list[Solution]) -> np.ndarray:
    """Angles and ranges of one target's solutions, in their order."""
    return np.array([(one.pan_rad, one.tilt_rad, one.range_m) for one in solutions])


@pytest.fixture(scope="module", params=["rocky8_simulated", "skew8_simulated"])
def rig(request: pytest.FixtureRequest) -> Rig:
    root = request.config.rootpath
    return load_rig(root / "configs" / "masts" / f"{request.param}.yaml").rig


@pytest.fixture(scope="module")
def eyes(rig: Rig) -> tuple[CameraModel, CameraModel]:
    return rig.camera_in_rover("navcam_left", 0.2, -0.3), rig.camera_in_rover("navcam_right", 0.2, -0.3)


def targets_and_pixels(rig: Rig, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Targets all round, some below and above the mast where no joint angles reach, and pixels."""
    rng = np.random.default_rng(13)
    targets = rig.mast.translation_m + rng.normal(size=(count, 3)) * [3.0, 3.0, 2.0]
    targets[::7, :2] = rig.mast.translation_m[:2] + rng.uniform(-0.05, 0.05, (len(targets[::7]), 2))
    return targets, rng.uniform(0.0, 1.0, (count, 2)) * rig.cameras["navcam_left"].model.size_px


# -- solve


def test_every_target_has_the_solutions_that_it_has_alone(rig: Rig) -> None:
    model = rig.cameras["navcam_left"].model
    targets, pixels = targets_and_pixels(rig, 210)
    many = solve_many(rig.mast, model, targets, pixels, from_pan_rad=0.4, from_tilt_rad=-0.2)
    assert many.pan_rad.shape == many.tilt_rad.shape == many.range_m.shape == (210, 4)
    refused = 0
    for row, (target, pixel) in enumerate(zip(targets, pixels, strict=True)):
        try:
            alone = solve(rig.mast, model, target, pixel, from_pan_rad=0.4, from_tilt_rad=-0.2)
        except Unreachable as refusal:
            assert many.refused[row] == refusal.code
            assert many.at(row) == []
            refused += 1
        else:
            assert many.refused[row] == ""
            assert numbers(many.at(row)) == pytest.approx(numbers(alone), abs=SAME)
            for name in ("pan_rad", "tilt_rad", "range_m"):
                padded = getattr(many, name)[row]
                assert np.isnan(padded[len(alone) :]).all()
                assert np.isfinite(padded[: len(alone)]).all()
    assert 10 < refused < 100


def test_solve_takes_arrays_as_project_does(rig: Rig) -> None:
    model = rig.cameras["navcam_left"].model
    targets, pixels = targets_and_pixels(rig, 6)
    at_centre = solve(rig.mast, model, targets.reshape(2, 3, 3))
    assert isinstance(at_centre, Solutions)
    assert at_centre.pan_rad.shape == (2, 3, 4) and at_centre.refused.shape == (2, 3)
    assert numbers(at_centre.at(1, 2)) == pytest.approx(numbers(solve(rig.mast, model, targets[5])), abs=SAME)
    one_target = solve(rig.mast, model, targets[5], pixels)
    assert isinstance(one_target, Solutions)
    assert numbers(one_target.at(3)) == pytest.approx(
        numbers(solve(rig.mast, model, targets[5], pixels[3])), abs=SAME
    )
    crossed = solve(rig.mast, model, targets[1:, None], pixels[None, :4])
    assert isinstance(crossed, Solutions)
    assert crossed.range_m.shape == (5, 4, 4)
    assert numbers(crossed.at(4, 2)) == pytest.approx(
        numbers(solve(rig.mast, model, targets[5], pixels[2])), abs=SAME
    )
    nothing = solve(rig.mast, model, np.zeros((0, 3)))
    assert isinstance(nothing, Solutions)
    assert nothing.pan_rad.shape == (0, 4) and nothing.refused.shape == (0,)


def test_a_choice_is_made_among_the_solutions_of_one_target(rig: Rig) -> None:
    model = rig.cameras["navcam_left"].model
    targets = np.array([[6.0, 1.0, 0.0], [4.0, -2.0, 0.3]])
    many = solve_many(rig.mast, model, targets)
    limits = (-3.0, 3.0), (-1.5, 1.5)
    wanted = choose(solve(rig.mast, model, targets[1]), *limits)
    assert numbers([choose(many.at(1), *limits)]) == pytest.approx(numbers([wanted]), abs=SAME)
    assert numbers(solve_many(rig.mast, model, targets[1]).at()) == pytest.approx(
        numbers(many.at(1)), abs=SAME
    )
    for index in ((), (0, 0)):
        with pytest.raises(IndexError, match=rf"{len(index)} indices where 1 are expected"):
            many.at(*index)


def test_a_bad_target_or_pixel_stops_no_other(rig: Rig) -> None:
    model = rig.cameras["navcam_left"].model
    good = [6.0, 1.0, 0.0]
    under = [*rig.mast.translation_m[:2], 5.0]
    many = solve_many(rig.mast, model, [good, [np.nan, 0, 0], under, [2e9, 0, 0], good])
    assert many.refused.tolist() == ["", "bad_target", "blind_cone", "bad_target", ""]
    assert many.at(0) == many.at(4)
    assert numbers(many.at(0)) == pytest.approx(numbers(solve(rig.mast, model, good)), abs=SAME)
    too_near = rig.mast.translation_m + rig.mast.rover_from_mast.vectors(
        np.array([rig.mast.axis_offset_m, 0.0, 0.0])
    )
    assert solve_many(rig.mast, model, [too_near]).refused.tolist() == ["too_near"]
    many = solve_many(rig.mast, model, good, [[500.0, 400.0], [np.inf, 0.0], [1e300, 1e300]])
    assert many.refused.tolist()[:2] == ["", "bad_pixel"]


@pytest.mark.parametrize(
    "targets,pixels,code,words",
    [
        (np.zeros((4, 2)), None, "bad_target", r"targets of shape \(4, 2\) where \(\.\.\., 3\) is expected"),
        (np.zeros((4, 3)), np.zeros((4, 3)), "bad_pixel", r"pixels of shape \(4, 3\) where \(\.\.\., 2\)"),
        (np.zeros((4, 3)), 7.0, "bad_pixel", r"pixels of shape \(\)"),
        (1.0, np.zeros((4, 2)), "bad_target", r"targets of shape \(\)"),
        (
            np.zeros((4, 3)),
            np.zeros((3, 2)),
            "bad_target",
            r"\(4, 3\) and pixels of shape \(3, 2\) do not go",
        ),
    ],
)
def test_arrays_of_a_wrong_shape_are_refused_by_name(
    rig: Rig, targets: np.ndarray, pixels: np.ndarray | None, code: str, words: str
) -> None:
    for ask in (solve, solve_many):
        with pytest.raises(Unreachable, match=words) as refusal:
            ask(rig.mast, rig.cameras["navcam_left"].model, targets, pixels)
        assert refusal.value.code == code


def test_what_is_wrong_for_every_target_is_raised(rig: Rig) -> None:
    model = rig.cameras["navcam_left"].model
    targets = np.array([[6.0, 1.0, 0.0], [4.0, -2.0, 0.3]])
    parallel = Mast(np.zeros(3), np.zeros(3), 0.1, np.pi / 2)
    with pytest.raises(Unreachable) as refusal:
        solve(parallel, model, targets)
    assert refusal.value.code == "parallel_axes"
    with pytest.raises(Unreachable) as refusal:
        solve(rig.mast, model, targets, from_pan_rad=np.nan)
    assert refusal.value.code == "bad_joints"


# -- triangulate


def clicks(eyes: tuple[CameraModel, CameraModel], count: int) -> tuple[np.ndarray, np.ndarray]:
    """Pixels of points in front of both eyes, with a third of a pixel of noise."""
    rng = np.random.default_rng(5)
    left, right = eyes
    points = left.ray(rng.uniform(100.0, 700.0, (count, 2)))
    at_m = points.origins_m + rng.uniform(2.0, 20.0, (count, 1)) * points.directions
    return left.project(at_m)[0] + rng.normal(0.0, 0.3, (count, 2)), right.project(at_m)[0]


def test_every_pair_of_pixels_has_the_point_that_it_has_alone(eyes: tuple[CameraModel, CameraModel]) -> None:
    left_px, right_px = clicks(eyes, 100)
    many = triangulate_many(*eyes, left_px, right_px, 0.3)
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
    one = triangulate_many(*eyes, left_px[5], right_px[5])  # no axis but the last: a point without one
    assert one.position_m.shape == (3,) and one.ray_gap_m.shape == one.refused.shape == ()
    nothing = triangulate(*eyes, np.zeros((0, 2)), np.zeros((0, 2)))
    assert isinstance(nothing, Triangulation)
    assert nothing.position_m.shape == (0, 3)


def test_a_bad_pair_of_pixels_stops_no_other() -> None:
    forward, right_hand, down = np.eye(3)
    H, V = 100 * right_hand + 50 * forward, 100 * down + 50 * forward
    left = CameraModel("CAHV", (101, 101), -0.1 * right_hand, forward, H, V)
    right = CameraModel("CAHV", (101, 101), 0.1 * right_hand, forward, H, V)
    many = triangulate_many(
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
    assert triangulate_many(ahead, aside, [[50, 50]], [50, 50]).refused.tolist() == ["behind_camera"]
    assert triangulate_many(aside, ahead, [[50, 50]], [50, 50]).refused.tolist() == ["behind_camera"]


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
    for ask in (triangulate, triangulate_many):
        with pytest.raises(NoStereoPoint, match=words) as refusal:
            ask(*eyes, left_px, right_px)
        assert refusal.value.code == "bad_pixel"


def test_what_hands_over_one_target_refuses_the_pixels_of_many(rig: Rig) -> None:
    pair, here = rig.stereo["navcam"], Joints(0.1, -0.6)
    for clicks_px in (([[592.6, 485.5]], [455.3, 494.3]), ([592.6, 485.5], [[455.3, 494.3], [455.3, 494.3]])):
        with pytest.raises(NoStereoPoint, match=r"where \(2,\) is expected") as refusal:
            hand_off(rig, pair, rig.stereo["hazcam"], here, *clicks_px)
        assert refusal.value.code == "bad_pixel"


def test_a_sigma_below_zero_is_refused_for_many_too(eyes: tuple[CameraModel, CameraModel]) -> None:
    with pytest.raises(ValueError, match="sigma_px is -1"):
        triangulate_many(*eyes, np.zeros((2, 2)), np.zeros((2, 2)), -1.0)


# -- both


def test_results_are_read_only_and_stay_so(rig: Rig, eyes: tuple[CameraModel, CameraModel]) -> None:
    solved = solve_many(rig.mast, rig.cameras["navcam_left"].model, [[6.0, 1.0, 0.0]])
    seen = triangulate_many(*eyes, *clicks(eyes, 2))
    for given in (solved, seen):
        for again in (given, copy.deepcopy(given), pickle.loads(pickle.dumps(given))):
            for name, array in vars(again).items():
                assert not array.flags.writeable, name
