"""The pointing loop in a small world whose truth is the test's own geometry."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Literal

import numpy as np
import pytest

from hil_tests.mastctl.motion.pointing_world import (
    LIMITS,
    SIZE_PX,
    World,
    click,
    loop_of,
    rig,
    rock,
    run,
    true_camera,
)
from mastctl.answers import Step
from mastctl.as_json import as_json
from mastctl.motion.requests import Aim, PixelTarget, PointingError, PointRequest

MIDDLE_PX = ((SIZE_PX[0] - 1) / 2, (SIZE_PX[1] - 1) / 2)
MEASURED_PX = 0.1  # the measured residual against the true one


def true_residual_px(
    world: World, frame_id: str, point_m: np.ndarray, aim_px: tuple[float, float]
) -> np.ndarray:
    return world.true_pixel(frame_id, point_m) - np.array(aim_px)


@pytest.mark.parametrize("pixel", [(75.0, 50.0), (250.5, 190.25), (149.5, 119.5)])
def test_a_clicked_pixel_lands_on_the_aim_and_the_residual_is_the_true_one(
    pixel: tuple[float, float],
) -> None:
    world = World()
    frame = world.shoot()
    point = world.true_point(frame, *pixel)
    result, _ = run(world, click(frame, *pixel, pointings=2))
    assert result["position_m"] is not None
    assert np.linalg.norm(np.array(result["position_m"]) - point) < 0.03
    assert len(result["pointings"]) == 2
    for pointing in result["pointings"]:
        assert pointing["residual_px"] is not None
        assert pointing["residual_sigma_px"] is not None
        truth = true_residual_px(world, pointing["frame_id"], point, MIDDLE_PX)
        assert np.abs(truth).max() < 0.5
        assert np.abs(np.array(pointing["residual_px"]) - truth).max() < MEASURED_PX
        assert max(pointing["residual_sigma_px"]) < MEASURED_PX


def test_a_position_is_as_sure_as_the_pixels_and_the_match_behind_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Of range, by hand: the disparity's sigma (two pixels, and the match) times r² / (f b)."""
    for pixel_sigma_px in (0.2, 0.02):
        world = World()
        frame = world.shoot()
        monkeypatch.setattr("mastctl.motion.loop.PIXEL_SIGMA_PX", pixel_sigma_px)
        steps: list[Step] = []
        loop_of(world, steps).run(click(frame, 150.0, 120.0))
        frames, stereo, place = (
            next(s["detail"] for s in steps if s["name"] == name)
            for name in ("frames", "stereo", "triangulate")
        )
        match_px = max(stereo["sigma_px"])
        assert match_px > 0.04, "where the match adds nothing, nothing is shown"
        assert frames["dt_s"] == stereo["dt_s"] == {"navcam_right": 0.0}, "both eyes saw one moment"
        disparity_px = np.sqrt(2 * pixel_sigma_px**2 + match_px**2)
        expected_m = disparity_px * place["range_m"] ** 2 / (645.0 * 0.2)
        assert np.linalg.norm(place["sigma_m"]) == pytest.approx(expected_m, rel=0.05)


@pytest.mark.parametrize("from_edge_px", [-6.0, -10.0])
def test_the_ground_behind_a_rocks_edge_does_not_pull_the_residual(from_edge_px: float) -> None:
    """Cameras stand 6 cm ahead of the tilt axis: a tilt of 0.1 rad shifts the ground by half a pixel."""
    world = World(scene=rock)
    frame = world.shoot()
    edge = true_camera("navcam_left", *world.true_joints(0.0)).pixel(np.array([2.34, 0.0, -0.2]))
    pixel = float(edge[0] + from_edge_px), 190.0
    point = world.true_point(frame, *pixel)
    result, _ = run(world, click(frame, *pixel))
    (pointing,) = result["pointings"]
    off = np.array(pointing["residual_px"]) - true_residual_px(world, pointing["frame_id"], point, MIDDLE_PX)
    assert np.abs(off).max() < 0.04
    assert (np.abs(off) < 3.0 * np.array(pointing["residual_sigma_px"])).all()


def test_a_wrong_mast_file_shows_as_a_residual_and_not_as_nothing() -> None:
    world, pixel = World(), (60.0, 50.0)
    frame = world.shoot()
    point = world.true_point(frame, *pixel)
    result, _ = run(world, click(frame, *pixel, pointings=2), rig(twist_error_rad=0.05))
    for pointing in result["pointings"]:
        assert pointing["residual_px"] is not None
        truth = true_residual_px(world, pointing["frame_id"], point, MIDDLE_PX)
        assert np.abs(np.array(pointing["residual_px"]) - truth).max() < MEASURED_PX
    first = true_residual_px(world, result["pointings"][0]["frame_id"], point, MIDDLE_PX)
    assert np.linalg.norm(first) > 1.0


def test_any_pixel_of_another_camera_can_be_the_aim() -> None:
    world, pixel = World(), (150.0, 120.0)
    frame = world.shoot("navcam_left")
    point = world.true_point(frame, *pixel)
    aim = Aim("pancam_right", 200.0, 130.0)
    result, steps = run(world, click(frame, *pixel, aim=aim, pointings=2))
    by = next(step["detail"]["confirmed_by"] for step in steps if step["name"] == "eyes")
    assert by == ["navcam_left", "navcam_right"], "pancam_left cannot see it so near"
    last = result["pointings"][-1]
    assert last["camera"] == "pancam_right"
    assert last["residual_px"] is not None
    truth = true_residual_px(world, last["frame_id"], point, (aim.x_px, aim.y_px))
    assert np.abs(truth).max() < 1.0
    assert np.abs(np.array(last["residual_px"]) - truth).max() < MEASURED_PX


def test_a_frame_from_another_pose_serves_while_the_target_is_in_view() -> None:
    world, pixel = World(), (150.0, 120.0)
    frame = world.shoot()
    point = world.true_point(frame, *pixel)
    world.place(0.08, -0.5)
    result, _ = run(world, click(frame, *pixel))
    residual = result["pointings"][0]["residual_px"]
    assert residual is not None
    truth = true_residual_px(world, result["pointings"][0]["frame_id"], point, MIDDLE_PX)
    assert np.abs(np.array(residual) - truth).max() < MEASURED_PX


def test_a_frame_from_a_pose_that_looks_elsewhere_is_refused_by_name() -> None:
    world = World()
    frame = world.shoot()
    world.place(1.0, -0.5)
    with pytest.raises(PointingError, match="since the clicked image of navcam_left") as refusal:
        run(world, click(frame, 150.0, 120.0))
    assert refusal.value.code == "not_in_view"
    assert not world.moves


@pytest.mark.parametrize("frame", ["rover", "site"])
def test_a_position_is_pointed_at_and_its_missing_residual_is_explained(
    frame: Literal["rover", "site"],
) -> None:
    world = World()
    result, steps = run(world, PointRequest(position_m=[4.0, 0.7, 0.0], frame=frame))
    (pointing,) = result["pointings"]
    assert pointing["residual_px"] is None
    assert pointing["residual_sigma_px"] is None
    assert "no picture" in pointing["note"]
    true_px = world.true_pixel(pointing["frame_id"], np.array([4.0, 0.7, 0.0]))
    for px in (true_px, pointing["predicted_px"]):
        assert px == pytest.approx(MIDDLE_PX, abs=1e-6)
    assert [step["name"] for step in steps] == ["rest", "solve", "before", "limits", "move", "settle", "look"]


def test_the_record_names_every_step_in_order_with_plain_numbers() -> None:
    world = World()
    result, steps = run(world, click(world.shoot(), 120.0, 90.0, pointings=2))
    one = ["solve", "limits", "move", "settle", "look", "measure", "eyes", "repeat"]
    assert [step["name"] for step in steps] == [
        "rest", "frames", "target", "stereo", "triangulate", *one, "triangulate", "rest", *one
    ]  # fmt: skip
    assert all(step["state"] == "done" for step in steps)
    assert all(step["duration_s"] >= 0.0 for step in steps)
    json.dumps([as_json(step) for step in steps])
    json.dumps(as_json(result), allow_nan=False)


def test_the_new_picture_is_exposed_after_the_head_has_settled() -> None:
    world = World()
    frame = world.shoot()
    result, steps = run(world, click(frame, 100.0, 90.0))
    settled = next(step for step in steps if step["name"] == "settle")
    new = world.by_id(result["pointings"][0]["frame_id"])
    assert new.exposure_began_s >= settled["started_s"] + settled["duration_s"]


def test_a_target_beyond_the_limits_is_refused_and_nothing_moves() -> None:
    world = World()
    steps: list[Step] = []
    loop = loop_of(world, steps)
    with pytest.raises(PointingError, match="beyond the limit") as refusal:
        loop.run(PointRequest(position_m=[-4.0, 0.1, 0.0]))
    assert refusal.value.code == "outside_limits"
    assert refusal.value.step == "solve"
    assert steps[-1]["state"] == "failed"
    assert steps[-1]["detail"]["code"] == "outside_limits"
    assert not world.moves


BAD = {
    "unknown_camera": PointRequest(pixel=PixelTarget("fishcam", "navcam_left-000001", 1, 1)),
    "frame_unknown": PointRequest(pixel=PixelTarget("navcam_left", "navcam_left-000099", 1, 1)),
    "wrong_camera": PointRequest(pixel=PixelTarget("navcam_right", "navcam_left-000001", 1, 1)),
    "outside_image": PointRequest(pixel=PixelTarget("navcam_left", "navcam_left-000001", 300.0, 1)),
    "bad_aim": PointRequest(position_m=[4.0, 0.0, 0.0], aim=Aim("fishcam", 1, 1)),
    "outside_image ": PointRequest(position_m=[4.0, 0.0, 0.0], aim=Aim("navcam_left", 1, 240.0)),
    "outside_limits": PointRequest(pan_rad=2.0, tilt_rad=0.0),
    "target_border": PointRequest(pixel=PixelTarget("navcam_left", "navcam_left-000001", 2.0, 120.0)),
}


NO_REQUEST: dict[str, Callable[[], object]] = {
    "finite number": lambda: PointRequest(position_m=[1.0, float("nan"), 0.0]),
    "finite number ": lambda: PixelTarget("navcam_left", "navcam_left-000001", float("nan"), 1),
    "'rover' or 'site'": lambda: PointRequest(
        position_m=[1.0, 0.0, 0.0],
        frame="board",  # type: ignore[arg-type]
    ),
    "valid number": lambda: PointRequest(pan_rad=True, tilt_rad=0.0),
    "goes with a pixel only": lambda: PointRequest(position_m=[4.0, 0.0, 0.0], pointings=2),
    "not with joint angles": lambda: PointRequest(pan_rad=0.0, tilt_rad=0.0, aim=Aim("navcam_left", 1, 1)),
    "less than or equal to 2": lambda: PointRequest(pan_rad=0.0, tilt_rad=0.0, pointings=3),
}


@pytest.mark.parametrize("words", NO_REQUEST)
def test_what_makes_no_sense_for_any_rig_never_becomes_a_request(words: str) -> None:
    with pytest.raises(ValueError, match=words.strip()):
        NO_REQUEST[words]()


@pytest.mark.parametrize("code", BAD)
def test_a_request_that_cannot_be_met_is_refused_and_nothing_moves(code: str) -> None:
    world = World()
    world.shoot()
    with pytest.raises(PointingError) as refusal:
        run(world, BAD[code])
    assert refusal.value.code == code.strip()
    assert str(refusal.value)
    assert "\n" not in str(refusal.value)
    assert not world.moves


def test_cancelling_during_the_move_stops_the_head() -> None:
    world, cancelled = World(), threading.Event()
    frame = world.shoot()

    def cancel_under_way() -> None:
        if world.moves:
            cancelled.set()

    world.on_read = cancel_under_way
    steps: list[Step] = []
    loop = loop_of(world, steps, cancelled=cancelled)
    with pytest.raises(PointingError) as refusal:
        loop.run(click(frame, 90.0, 60.0))
    assert refusal.value.code == "stopped"
    assert steps[-1]["name"] == "settle"


def test_a_failure_after_the_first_pointing_keeps_its_result() -> None:
    world = World()
    frame = world.shoot()

    def lost(camera: str, number: int, image: np.ndarray) -> np.ndarray:
        return np.full_like(image, 90) if number > frame.sequence + 5 else image

    world.image = lost
    with pytest.raises(PointingError) as refusal:
        run(world, click(frame, 120.0, 90.0, pointings=2))
    assert refusal.value.code == "target_not_found"
    assert refusal.value.result is not None
    assert len(refusal.value.result["pointings"]) == 1
    assert refusal.value.result["pointings"][0]["residual_px"] is not None


def preview(world: World, request: PointRequest) -> Any:
    return loop_of(world, []).preview(request)


def test_a_preview_tells_what_a_pointing_then_finds_and_nothing_moves() -> None:
    world, pixel = World(), (150.0, 120.0)
    frame = world.shoot()
    point = world.true_point(frame, *pixel)
    told = preview(world, click(frame, *pixel))
    assert (world.moves, world.stops) == ([], 0)
    assert told["other_camera"] == "navcam_right" and told["refused"] is None
    assert np.abs(np.array(told["pixel_px"]) - pixel).max() < 0.2
    off_m = np.array(told["position_m"]) - point
    assert (np.abs(off_m) < 4 * np.array(told["sigma_m"]) + 1e-3).all()
    assert told["range_sigma_m"] <= np.linalg.norm(told["sigma_m"]) + 1e-12
    result, _ = run(world, click(frame, *pixel))
    assert told["goal_rad"] == pytest.approx(
        (result["pointings"][0]["commanded_pan_rad"], result["pointings"][0]["commanded_tilt_rad"]), abs=2e-3
    )


def test_a_preview_of_what_the_head_cannot_reach_still_tells_where_it_is() -> None:
    world = World()
    frame = world.shoot()
    world.limits = replace(LIMITS, tilt_rad=(-0.001, 0.001))
    told = loop_of(world, []).preview(click(frame, 150.0, 60.0))
    assert told["range_m"] > 0.5
    assert told["refused"] is not None and told["refused"]["code"] == "outside_limits", told["refused"]
    assert (world.moves, world.stops) == ([], 0)
