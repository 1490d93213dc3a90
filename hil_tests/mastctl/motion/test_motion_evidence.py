"""A picture that did not move as the joints say is no evidence: the pointing ends in `bad_frame`.

Nor is one that a later picture does not repeat: `not_repeated`.

The small world's geometry, pictures and motion are its own; what its cameras do wrong is written here.
"""

from __future__ import annotations

import re
import threading
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest

from calib.matching.shown_view import Posed, shown_view
from drivers.errors import NoReply
from hil_tests.mastctl.motion.pointing_world import SIZE_PX, World, clean, click, moving_world, rig, run
from mastctl.answers import PointingResult
from mastctl.devices.frames import StampedFrame
from mastctl.devices.joint_history import HeadReading
from mastctl.motion.requests import Aim, PointingError, PointRequest

MIDDLE_PX = (np.array(SIZE_PX) - 1) / 2
LATE_S = 0.3
SAME_RAD = 3e-3
"""Pictures of 300 columns: a pixel is 1.6 mrad."""
TRUE_PX = 0.3
CLICKS_PX = [tuple(xy) for xy in np.random.default_rng(30).uniform((80, 30), (270, 200), (4, 2)).round(1)]
"""Four pointings, as in the trial that found the defect; moves of 0.04 to 0.2 rad."""


def buffered(world: World) -> None:
    """Every camera delivers, with a new stamp, the view of its exposure before."""
    last: dict[str, tuple[float, float]] = {}

    def view(camera: str, time_s: float, joints: tuple[float, float]) -> tuple[float, float]:
        shown = last.get(camera, joints)
        last[camera] = joints
        return shown

    world.view = view


def late(world: World, late_s: float = LATE_S) -> list[tuple[float, float]]:
    """Every camera stamps its pictures too new; returned is the list that the views they show are put in."""
    shown: list[tuple[float, float]] = []

    def view(camera: str, time_s: float, joints: tuple[float, float]) -> tuple[float, float]:
        shown.append(world.true_joints(time_s - late_s))
        return shown[-1]

    world.view = view
    return shown


def refusal(world: World, request: PointRequest) -> PointingError:
    with pytest.raises(PointingError) as caught:
        run(world, request)
    assert "\n" not in str(caught.value)
    return caught.value


def angles_told(message: str) -> list[tuple[float, float]]:
    """The views that a refusal names: what is shown, then what should be."""
    return [(float(a), float(b)) for a, b in re.findall(r"pan (-?\d\.\d+), tilt (-?\d\.\d+)", message)]


@pytest.mark.parametrize("clicked_px", CLICKS_PX)
def test_pictures_of_before_the_move_with_new_stamps_are_told(clicked_px: tuple[float, float]) -> None:
    world = World()
    buffered(world)
    error = refusal(world, click(world.shoot(), *clicked_px))
    assert error.code == "bad_frame", str(error)
    assert error.step == "look"
    assert error.result is None
    assert "that of before the move" in str(error)
    shown, told = angles_told(str(error))
    assert shown == pytest.approx((0.0, -0.45), abs=SAME_RAD)
    assert told == pytest.approx(world.moves[0], abs=1e-3)


@pytest.mark.parametrize("clicked_px", CLICKS_PX)
def test_an_honest_world_is_seen_to_move(clicked_px: tuple[float, float]) -> None:
    world = World()
    frame = world.shoot()
    point = world.true_point(frame, *clicked_px)
    result, _ = run(world, click(frame, *clicked_px, pointings=2))
    for pointing, verdicts in zip(result["pointings"], ({"seen", "small_move"}, {"small_move"}), strict=True):
        assert pointing["residual_px"] is not None
        truth = world.true_pixel(pointing["frame_id"], point) - MIDDLE_PX
        assert np.abs(np.array(pointing["residual_px"]) - truth).max() < TRUE_PX
        assert set(pointing["motion_evidence"]) == {"navcam_left", "navcam_right"}
        for told in pointing["motion_evidence"].values():
            assert told["verdict"] in verdicts
            assert np.abs(told["off_rad"]).max() < 1e-3


CLICK_PX = (90.0, 70.0)
NEAR_PX = (153.0, 121.0)
"""The head moves by 6 mrad: less than play may be."""


@pytest.mark.parametrize("clicked_px", [CLICK_PX, NEAR_PX])
@pytest.mark.parametrize("late_s", [0.05, 0.215, 1.0])
def test_pictures_older_than_their_stamps_give_no_false_residual(
    late_s: float, clicked_px: tuple[float, float]
) -> None:
    world = World()
    late(world, late_s)
    frame = world.shoot()
    point = world.true_point(frame, *clicked_px)
    try:
        result: PointingResult | None = run(world, click(frame, *clicked_px, pointings=2))[0]
    except PointingError as error:
        assert error.code in ("bad_frame", "not_repeated"), str(error)
        assert late_s > 0.15, "the head was at rest for so long: nothing was wrong"
        result = error.result
    for pointing in () if result is None else result["pointings"]:
        assert pointing["residual_px"] is not None
        truth = world.true_pixel(pointing["frame_id"], point) - MIDDLE_PX  # where the head stood by the stamp
        assert np.abs(np.array(pointing["residual_px"]) - truth).max() < TRUE_PX


def test_a_residual_is_told_with_how_old_the_pictures_behind_it_may_be() -> None:
    world = World()
    result, steps = run(world, click(world.shoot(), *CLICK_PX))
    told = result["pointings"][0]["motion_evidence"]["navcam_left"]
    assert told["repeated_after_s"] >= 1.0 and np.abs(told["apart_px"]).max() < 0.2
    settled = next(step for step in steps if step["name"] == "settle")
    began_s = world.by_id(result["pointings"][0]["frame_id"]).exposure_began_s
    assert told["fresh_to_s"] == pytest.approx(
        began_s - settled["started_s"] - settled["duration_s"], abs=0.01
    )
    once, steps = run(world, click(world.shoot(), *CLICK_PX), repeat_after_s=0.0)
    assert "repeat" not in [step["name"] for step in steps]
    assert "fresh_to_s" not in once["pointings"][0]["motion_evidence"]["navcam_left"]


def test_a_target_or_a_rover_that_moves_is_told_as_that() -> None:
    world = moving_world(1.0, late_s=0.0)
    error = refusal(world, click(world.shoot(), *CLICK_PX))
    assert (error.code, error.step) == ("not_repeated", "repeat")
    assert re.match(
        r"1\.\d\d s later navcam_left shows the target \+[01]\.\d\d, [+-]0\.0\d px elsewhere", str(error)
    )
    assert str(error).endswith("or the target or the rover moves")


def between_the_pictures(world: World, act: Callable[[], object]) -> None:
    """Do something when the second picture of a pointing is asked for."""
    frames = world.frames

    def later(
        cameras: Sequence[str], exposed_after_s: float, timeout_s: float, check: Any = None
    ) -> dict[str, StampedFrame]:
        if world.moves and len(cameras) == 1:
            act()
            check()  # as the devices do while they wait
        return frames(cameras, exposed_after_s, timeout_s)

    world.frames = later  # type: ignore[method-assign]


def test_a_head_that_dithers_by_a_count_repeats_what_it_shows() -> None:
    world, count_rad = World(), 0.0015
    frame = world.shoot()
    point = world.true_point(frame, *CLICK_PX)
    between_the_pictures(world, lambda: world.place(world.moves[0][0] + count_rad, world.moves[0][1]))
    (pointing,) = run(world, click(frame, *CLICK_PX))[0]["pointings"]
    assert pointing["residual_px"] is not None
    truth = world.true_pixel(pointing["frame_id"], point) - MIDDLE_PX
    assert abs(truth[0]) > 0.8 and np.abs(np.array(pointing["residual_px"]) - truth).max() < TRUE_PX


@pytest.mark.parametrize("during", ["the head is watched", "the picture is waited for"])
def test_a_stop_before_the_second_picture_ends_the_pointing_at_once(during: str) -> None:
    world, cancelled = World(), threading.Event()
    reads = world.read

    def read() -> HeadReading:
        if world.moves and world.clock.now_s() > world._begun_s + 1.0:  # the move takes 0.2 s
            cancelled.set()
        return reads()

    if during == "the head is watched":
        world.read = read  # type: ignore[method-assign]
    between_the_pictures(world, cancelled.set)
    with pytest.raises(PointingError) as refused:
        run(world, click(world.shoot(), *CLICK_PX), cancelled=cancelled)
    assert (refused.value.code, refused.value.step, refused.value.result) == ("stopped", "repeat", None)


def moved(world: World, change: Callable[[str, tuple[float, float]], tuple[float, float]]) -> None:
    """From the first move on a camera shows the view that ``change(camera, joints)`` says."""
    world.view = lambda camera, time_s, joints: change(camera, joints) if world.moves else joints


def part_of_the_way(share: float) -> Callable[[str, tuple[float, float]], tuple[float, float]]:
    return lambda camera, joints: (share * joints[0], -0.45 + share * (joints[1] + 0.45))


@pytest.mark.parametrize("share", [-1.0, 0.0, 0.3, 0.8, 1.3, 2.0])
def test_a_picture_that_moved_too_little_too_far_or_the_other_way_is_told(share: float) -> None:
    world = World()
    moved(world, part_of_the_way(share))
    error = refusal(world, click(world.shoot(), *CLICK_PX))
    assert error.code == "bad_frame", str(error)
    pan, tilt = world.moves[0]
    shown, told = angles_told(str(error))
    assert shown == pytest.approx((share * pan, -0.45 + share * (tilt + 0.45)), abs=SAME_RAD)
    assert told == pytest.approx((pan, tilt), abs=1e-3)


@pytest.mark.parametrize("eye", ["navcam_left", "navcam_right"])
def test_one_eye_that_lags_is_the_one_that_is_named(eye: str) -> None:
    world = World()
    moved(world, lambda camera, joints: (0.0, -0.45) if camera == eye else joints)
    error = refusal(world, click(world.shoot(), *CLICK_PX))
    assert error.code == "bad_frame"
    assert str(error).startswith(f"{eye}: the picture shows the view of pan ")


@pytest.mark.parametrize("slip_rad", [(0.0349, -0.01), (0.0, 0.02), (-0.012, 0.0)])
def test_joints_that_claim_what_both_pictures_deny_are_told(slip_rad: tuple[float, float]) -> None:
    world = World(slip_rad=slip_rad)
    error = refusal(world, click(world.shoot(), *CLICK_PX))
    assert error.code == "bad_frame"
    assert "joints and pictures contradict each other" in str(error)
    pan, tilt = world.moves[0]
    assert angles_told(str(error))[0] == pytest.approx((pan + slip_rad[0], tilt + slip_rad[1]), abs=SAME_RAD)


def test_a_pattern_that_repeats_with_the_move_is_said_to_be_too_plain() -> None:
    world = World()
    tile = np.random.default_rng(3).integers(40, 220, (6, 6), dtype=np.uint8)
    pattern = np.tile(np.kron(tile, np.ones((4, 4), np.uint8)), (10, 13))[: SIZE_PX[1], : SIZE_PX[0]]
    world.image = lambda camera, number, image: pattern.copy()
    result, _ = run(world, PointRequest(position_m=[4.0, 0.02, 0.0]))
    assert result["pointings"][0]["motion_evidence"]["navcam_left"]["verdict"] == "too_plain"


def test_the_aiming_pair_looks_before_the_move_where_that_is_of_use() -> None:
    world = World()
    clicked = world.shoot("navcam_left")
    aim = Aim("pancam_left", *MIDDLE_PX)
    result, steps = run(world, click(clicked, 160.0, 130.0, aim=aim))
    assert [step["name"] for step in steps].count("before") == 1
    assert result["pointings"][0]["motion_evidence"]["pancam_left"]["verdict"] in ("seen", "small_move")
    world = World()
    buffered(world)
    error = refusal(world, click(world.shoot("navcam_left"), 120.0, 100.0, aim=aim))
    assert error.code == "bad_frame"
    assert str(error).startswith("pancam_left: ")


def without(world: World, *dead: str) -> None:
    """Some cameras do not answer."""
    frames = world.frames

    def fewer(
        cameras: Sequence[str], exposed_after_s: float, timeout_s: float, check: Any = None
    ) -> dict[str, StampedFrame]:
        for camera in cameras:
            if camera in dead:
                raise NoReply("unplugged", device=camera)
        return frames(cameras, exposed_after_s, timeout_s)

    world.frames = fewer  # type: ignore[method-assign]


def test_a_stale_picture_is_told_though_the_partner_does_not_answer() -> None:
    world = World()
    without(world, "navcam_right")
    buffered(world)
    error = refusal(world, PointRequest(position_m=[4.0, 0.7, 0.0]))
    assert error.code == "bad_frame" and "that of before the move" in str(error)


def test_an_aiming_camera_that_is_silent_before_the_move_moves_nothing() -> None:
    world = World()
    without(world, "navcam_left")
    error = refusal(world, PointRequest(position_m=[4.0, 0.7, 0.0]))
    assert (error.code, error.step) == ("no_reply", "before") and not world.moves


def posed(camera: str, told: tuple[float, float], shown: tuple[float, float] | None = None) -> Posed:
    """The picture of one view with the angles told for it."""
    return Posed(clean(camera, *(shown or told)), *told)


@pytest.mark.parametrize("played_rad", [0.003, 0.0044])
def test_a_small_move_of_which_play_took_half_is_small_and_not_too_plain(played_rad: float) -> None:
    before, beside = (posed(name, (0.0, -0.45)) for name in ("navcam_left", "navcam_right"))
    after = posed("navcam_left", (0.009, -0.45), (0.009 - played_rad, -0.45))
    seen = shown_view(rig(), "navcam_left", before, after, ("navcam_right", beside))
    assert seen.verdict == "small_move" and seen.off_rad[0] == pytest.approx(-played_rad, abs=4e-4)
