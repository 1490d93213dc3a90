"""The pointing loop with one camera, in a small world whose truth is the test's own geometry."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from calib.geometry.rig import Rig
from hil_tests.mastctl.motion.pointing_world import SIZE_PX, World, click, rig, run, true_camera
from mastctl.answers import PointingResult
from mastctl.motion.requests import PlaneTarget, PointingError

MIDDLE_PX = ((SIZE_PX[0] - 1) / 2, (SIZE_PX[1] - 1) / 2)
EYE = "navcam_left"
PIXEL = (75.0, 50.0)


def alone() -> Rig:
    """One camera, and a mast file that is sure of itself: parallax is small in little pictures."""
    fit = {"parameters": ["mast.rotation_rad.z"], "covariance": [[1e-10]]}
    return replace(rig(), stereo={}, fit=fit)


def truth_of(world: World, result: PointingResult, point: np.ndarray) -> list[np.ndarray]:
    return [world.true_pixel(one["frame_id"], point) - np.array(MIDDLE_PX) for one in result["pointings"]]


def pointed(world: World, **more: Any) -> tuple[PointingResult, np.ndarray, list[str]]:
    frame = world.shoot()
    point = world.true_point(frame, *PIXEL)
    if more.pop("range_told", False):
        eye = true_camera(EYE, frame.pan_rad, frame.tilt_rad)
        more["range_m"] = float(np.linalg.norm(point - eye.position_m))
    result, steps = run(world, click(frame, *PIXEL, **more), believed=alone())
    return result, point, [step["name"] for step in steps]


def test_a_range_told_brings_the_target_home_at_once() -> None:
    world = World()
    result, point, steps = pointed(world, range_told=True)
    [off] = truth_of(world, result, point)
    assert np.abs(off).max() < 0.3 and result["range_from"] == "given"
    assert np.linalg.norm(np.array(result["position_m"]) - point) < 0.01
    assert "sight" in steps and "stereo" not in steps and "eyes" not in steps


def test_a_plane_told_does_too_and_the_ground_is_level_by_default() -> None:
    world = World()
    result, point, _ = pointed(world, plane=PlaneTarget((0.0, 0.0, 0.0)))
    [off] = truth_of(world, result, point)
    assert np.abs(off).max() < 0.3 and result["range_from"] == "plane"


def test_an_unknown_ranges_interval_holds_until_the_second_pointing() -> None:
    world = World()
    result, point, _ = pointed(world, pointings=2)
    first, second = truth_of(world, result, point)
    one = result["pointings"][0]
    assert one["predicted_px"] is not None and one["predicted_covariance_px2"] is not None
    away = world.true_pixel(one["frame_id"], point) - np.array(one["predicted_px"])
    known = np.array(one["predicted_covariance_px2"])
    assert away @ np.linalg.solve(known, away) < 5.99
    told, _, _ = pointed(World(), range_told=True)
    along, along_told = (
        np.linalg.eigvalsh(np.array(each["pointings"][0]["predicted_covariance_px2"]))[1]
        for each in (result, told)
    )
    assert along > 1.5 * along_told, "it does not know the range, and says so"
    assert one["residual_px"] is not None and one["residual_sigma_px"] is not None
    assert np.abs(np.array(one["residual_px"]) - first).max() < 0.1, "measured as ever"
    assert np.abs(second).max() < 0.3 < np.abs(first).max()
    assert result["range_from"] == "parallax" and result["range_interval_m"] is not None
    eye = true_camera(
        EYE, result["pointings"][1]["measured_pan_rad"], result["pointings"][1]["measured_tilt_rad"]
    )
    near, far = result["range_interval_m"]
    assert far is not None and near <= np.linalg.norm(point - eye.position_m) <= far


def test_an_eye_of_a_pair_points_alone_if_the_range_is_told() -> None:
    world = World()
    frame = world.shoot()
    point = world.true_point(frame, *PIXEL)
    eye = true_camera(EYE, frame.pan_rad, frame.tilt_rad)
    away_m = float(np.linalg.norm(point - eye.position_m))
    result, steps = run(world, click(frame, *PIXEL, range_m=away_m))
    assert np.abs(truth_of(world, result, point)[0]).max() < 0.3
    assert "stereo" not in {step["name"] for step in steps} and result["range_from"] == "given"
    assert result["range_interval_m"] == pytest.approx((result["range_m"], result["range_m"]), rel=1e-6)


def test_what_looks_like_the_target_far_from_its_line_is_no_target() -> None:
    world = World()
    frame = world.shoot()
    moved = len(world.moves)

    def shifted(camera: str, number: int, image: np.ndarray) -> np.ndarray:
        return np.roll(image, 30, axis=0) if len(world.moves) > moved else image

    world.image = shifted
    with pytest.raises(PointingError) as refused:
        run(world, click(frame, *PIXEL, range_m=4.0), believed=alone())
    assert refused.value.code in ("off_the_line", "bad_frame")


def test_a_plane_that_the_ray_does_not_meet_moves_nothing() -> None:
    world = World()
    with pytest.raises(PointingError, match="does not meet the plane"):
        run(world, click(world.shoot(), *PIXEL, plane=PlaneTarget((0.0, 0.0, -9.0))), believed=alone())
    assert world.moves == []
