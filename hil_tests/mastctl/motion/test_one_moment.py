"""Eyes that expose one after the other: measured is only what stands still, or nearly, in between."""

from __future__ import annotations

import numpy as np
import pytest

from hil_tests.mastctl.motion.pointing_world import LATE_S, World, click, moving_world, rig, run
from mastctl.answers import Step
from mastctl.motion.measurement import RigCameras
from mastctl.motion.requests import PointingError


def detail(steps: list[Step], name: str) -> dict[str, object]:
    return dict(next(step["detail"] for step in steps if step["name"] == name))


def test_eyes_that_expose_apart_measure_what_stands_still() -> None:
    world = moving_world(0.0)
    result, steps = run(world, click(world.shoot(), 90.0, 70.0))
    found = detail(steps, "stereo")
    assert found["dt_s"] == {"navcam_right": pytest.approx(LATE_S)}
    assert found["image_speed_px_per_s"] < 2.0  # type: ignore[operator]  # of the noise: 0.1 px in 0.1 s
    residual_px = result["pointings"][0]["residual_px"]
    assert residual_px is not None and np.abs(residual_px).max() < 0.3


def checked(world: World) -> dict[str, object]:
    """What the check says of a pair that is taken now."""
    cameras = RigCameras(world, rig())  # type: ignore[arg-type]
    resting = world.read()
    views = cameras.new(("navcam_left", "navcam_right"), world.clock.now_s(), resting)
    one, other = views["navcam_left"], views["navcam_right"]
    return cameras.check_one_moment(one, np.array([150.0, 120.0]), [other], resting)


def test_what_moves_by_half_a_pixel_between_the_eyes_is_not_measured() -> None:
    world = moving_world(60.0)
    words = r"moves at (59|60)\.\d px/s in navcam_left, 0\.\d\d px between exposures 10\.0 ms apart"
    with pytest.raises(PointingError, match=words) as told:
        run(world, click(world.shoot(), 90.0, 70.0))
    assert told.value.code == "target_moving" and told.value.step == "stereo"
    assert not world.moves


def test_what_is_gone_a_moment_later_is_not_measured() -> None:
    words = "exposed 2.0 ms apart, and 100.0 ms later navcam_left does not see the target where it was"
    with pytest.raises(PointingError, match=words) as told:
        checked(moving_world(400.0, late_s=0.002))
    assert told.value.code == "target_moving"
