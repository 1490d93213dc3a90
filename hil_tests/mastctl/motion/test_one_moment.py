"""Eyes that expose one after the other: measured is only what stands still, or nearly, in between."""

from __future__ import annotations

import numpy as np
import pytest

from hil_tests.mastctl.motion.pointing_world import LATE_S, World, click, moving_world, rig, run
from mastctl.motion.evidence import check_one_moment
from mastctl.motion.looking import RigCameras
from mastctl.motion.results import PointingError, Step
from mastctl.motion.settings import PointingSettings


def detail(steps: list[Step], name: str) -> dict[str, object]:
    return dict(next(step.detail for step in steps if step.name == name))


def test_eyes_that_expose_together_need_no_further_picture() -> None:
    world = World()
    _, steps = run(world, click(world.shoot(), 90.0, 70.0))
    for name in ("stereo", "eyes"):
        assert detail(steps, name)["dt_s"] == {"navcam_right": 0.0}
        assert "image_speed_px_per_s" not in detail(steps, name)


def test_eyes_that_expose_apart_measure_what_stands_still() -> None:
    world = moving_world(0.0)
    result, steps = run(world, click(world.shoot(), 90.0, 70.0))
    for name in ("stereo", "eyes"):
        found = detail(steps, name)
        assert found["dt_s"] == {"navcam_right": pytest.approx(LATE_S)}
        assert found["image_speed_px_per_s"] < 2.0  # type: ignore[operator]  # of the noise: 0.1 px in 0.1 s
    residual_px = result.pointings[0].residual_px
    assert residual_px is not None and np.abs(residual_px).max() < 0.3


def checked(world: World) -> dict[str, object]:
    """What the check says of a pair that is taken now."""
    settings = PointingSettings()
    eyes, resting = RigCameras(world, rig(), settings), world.read()
    views = eyes.new(("navcam_left", "navcam_right"), world.clock.now_s(), resting)
    one, other = views["navcam_left"], views["navcam_right"]
    return check_one_moment(eyes, settings, one, np.array([150.0, 120.0]), [other], resting)


def test_what_moves_by_half_a_pixel_between_the_eyes_is_not_measured() -> None:
    world = moving_world(60.0)
    words = r"moves at (59|60)\.\d px/s in navcam_left, 0\.\d\d px between exposures 10\.0 ms apart"
    with pytest.raises(PointingError, match=words) as told:
        run(world, click(world.shoot(), 90.0, 70.0))
    assert told.value.code == "target_moving" and told.value.step == "stereo"
    assert not world.moves


def test_the_same_speed_does_no_harm_where_the_eyes_are_nearly_together() -> None:
    found = checked(moving_world(60.0, late_s=0.002))
    assert found["image_speed_px_per_s"] == pytest.approx(60.0, abs=1.0)
    assert found["moved_px"] == pytest.approx(0.12, abs=0.01)


def test_an_eye_that_exposes_before_the_first_one_counts_alike() -> None:
    still = checked(moving_world(0.0, late_s=-LATE_S))
    assert still["dt_s"] == {"navcam_right": pytest.approx(-LATE_S)}
    assert "image_speed_px_per_s" in still
    with pytest.raises(PointingError, match=r"0\.6\d px between exposures 10\.0 ms apart") as told:
        checked(moving_world(62.0, late_s=-LATE_S))
    assert told.value.code == "target_moving"


def test_what_is_gone_a_moment_later_is_not_measured() -> None:
    words = "exposed 2.0 ms apart, and 100.0 ms later navcam_left does not see the target where it was"
    with pytest.raises(PointingError, match=words) as told:
        checked(moving_world(400.0, late_s=0.002))
    assert told.value.code == "target_moving"
