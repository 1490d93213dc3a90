"""The automatic exposure, on a made-up camera whose grey levels follow light times exposure time."""

from __future__ import annotations

import numpy as np
import pytest

from drivers.v4l2.exposure import GROUPS, TARGET, TOLERANCE, AutoExposureSettings, ExposureControl

SETTINGS = AutoExposureSettings(shortest_s=1e-4, longest_s=0.03)


def picture(light: float, exposure_s: float) -> np.ndarray:
    """A ramp from dark to ``light`` grey levels a second, clipped as a sensor does."""
    ramp = np.linspace(0, light * exposure_s, 64 * 64).reshape(64, 64)
    return np.clip(ramp, 0, 255).astype(np.uint8)


def settle(control: ExposureControl, light: float, steps: int = 12) -> list[float]:
    return [control.see("left", picture(light, control.exposure_s), control.exposure_s) for _ in range(steps)]


@pytest.mark.parametrize("light", [2e4, 1e5, 1e6])
def test_the_percentile_comes_to_the_target_and_stays(light: float) -> None:
    control = ExposureControl(SETTINGS, 0.005)
    exposures_s = settle(control, light)
    level = np.percentile(picture(light, control.exposure_s), 95)
    assert abs(level - TARGET) <= TOLERANCE
    assert exposures_s[-6:] == [exposures_s[-1]] * 6


@pytest.mark.parametrize(("light", "bound_s"), [(1e9, 1e-4), (10.0, 0.03)])
def test_bounds_are_kept(light: float, bound_s: float) -> None:
    control = ExposureControl(SETTINGS, 0.005)
    assert settle(control, light)[-1] == bound_s


def test_nothing_changes_during_a_measurement() -> None:
    control = ExposureControl(SETTINGS, 0.005)
    control.hold()
    control.hold()
    control.release()
    assert control.is_fixed and set(settle(control, 1e7)) == {0.005}
    control.release()
    assert not control.is_fixed and settle(control, 1e7)[-1] < 0.005


def test_cameras_of_a_group_have_one_exposure_by_the_brightest() -> None:
    settings = AutoExposureSettings(group="navcam")
    left, right = GROUPS.join("left", settings, 0.005), GROUPS.join("right", settings, 0.005)
    try:
        assert left is right
        for _ in range(12):
            left.see("left", picture(3e4, left.exposure_s), left.exposure_s)
            right.see("right", picture(6e4, right.exposure_s), right.exposure_s)
        level = np.percentile(picture(6e4, right.exposure_s), 95)
        assert abs(level - TARGET) <= TOLERANCE
    finally:
        GROUPS.leave("left", settings)
        GROUPS.leave("right", settings)
    again = GROUPS.join("left", settings, 0.011)
    GROUPS.leave("left", settings)
    assert again is not left and again.exposure_s == 0.011


def test_a_picture_taken_with_another_exposure_is_not_judged() -> None:
    control = ExposureControl(SETTINGS, 0.005)
    assert control.see("left", picture(1e7, 0.02), 0.02) == 0.005
