"""What has changed since reference pictures: the truth is the campaign's own pinholes and turns."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from calib.calibrate.drift import ALARM_SIGMAS, VIEW_SIGMA, ViewShift, find_drift, seen_again, view_change
from calib.geometry.cahvor import CameraModel
from hil_tests.support.feature_days import FOCAL_PX, SIZE, ChangedRig, FeatureSite, rig

SEED = 11


def look_at(truth: ChangedRig, seed: int = SEED):  # type: ignore[no-untyped-def]
    return FeatureSite(np.random.default_rng(seed)).look(truth)


@pytest.mark.parametrize("seed", range(5))
def test_days_of_weather_light_and_moving_rocks_are_no_change(seed: int) -> None:
    drift = look_at(ChangedRig(), seed)
    assert drift.sigmas < ALARM_SIGMAS - 1.0
    assert (drift.changed, drift.sentence) == (False, "")


CORNER_PX = np.hypot(*SIZE) / 2


@pytest.mark.parametrize(
    ("truth", "moved_px"),
    [
        (ChangedRig(turned={"navcam_left": np.array([0.0, 1.8e-3, 0.0])}), 1.8e-3 * FOCAL_PX),
        (ChangedRig(focal={"navcam_right": 3e-3}), 3e-3 * CORNER_PX),
        (ChangedRig(slip=(3e-3, 0.0)), 3e-3 * FOCAL_PX),
        (ChangedRig(slip=(0.0, -3e-3)), 3e-3 * FOCAL_PX),
        (ChangedRig(rover=np.array([4e-3, 0.0, 0.0])), 4e-3 * FOCAL_PX),
    ],
    ids=["bump", "focus", "pan", "tilt", "rover"],
)
def test_a_change_is_found_with_its_size(truth: ChangedRig, moved_px: float) -> None:
    drift = look_at(truth)
    assert drift.changed
    assert drift.moved_px == pytest.approx(moved_px, rel=0.35)  # angles off the axis move pixels by more
    assert drift.sentence == f"the images moved by up to {drift.moved_px:.2f} px, {drift.sigmas:.0f} sigma"


def test_rocks_that_move_together_do_not_move_a_view() -> None:
    rng = np.random.default_rng(SEED)
    pixels = rng.uniform(50, 700, (40, 2))
    moved = 0.05 * rng.normal(size=(40, 2)) + np.array([1.5, -0.5])
    moved[:12] += [8.0, 6.0]
    change = view_change(ViewShift("navcam_left", 0, 0.0, 0.0, pixels, moved, np.full(40, 0.05)), SIZE)
    assert change is not None
    middle = (np.array(SIZE) - 1) / 2
    assert change.agreeing == pytest.approx(28 / 40, abs=0.05)
    # the numbers are of the picture's middle
    predicted = change.numbers[:2] + change.numbers[3] * (pixels.mean(axis=0) - middle)
    np.testing.assert_allclose(predicted, [1.5, -0.5], atol=0.1)


@pytest.mark.parametrize("times", [1.0, 3.0], ids=["as told", "three times as told"])
def test_a_view_is_as_unsure_as_its_features_scatter(times: float) -> None:
    rng = np.random.default_rng(SEED)
    normalised = []
    for _ in range(300):
        pixels = rng.uniform(50, 700, (60, 2))
        moved = times * 0.1 * rng.normal(size=(60, 2))
        change = view_change(ViewShift("navcam_left", 0, 0.0, 0.0, pixels, moved, np.full(60, 0.1)), SIZE)
        assert change is not None
        own = change.covariance - np.diag(VIEW_SIGMA**2)
        normalised.append(change.numbers @ np.linalg.solve(own, change.numbers) / 4)
    # robust weights cost a tenth; the mean over 300 views of four numbers is good to 4 %
    assert 0.8 < np.mean(normalised) < 1.1


def test_another_scene_says_nothing_instead_of_something() -> None:
    rng = np.random.default_rng(SEED)
    views = [
        ViewShift(
            eye,
            pose,
            0.5 * pose,
            -0.3,
            rng.uniform(0, 700, (30, 2)),
            rng.uniform(-25, 25, (30, 2)),
            np.full(30, 0.1),
        )
        for pose in range(4)
        for eye in ("navcam_left", "navcam_right")
    ]
    drift = find_drift(rig(), views)
    assert (drift.views, drift.changed) == (0, False)
    assert len(drift.silent) == 8
    assert "navcam_left at rest 0" in drift.silent


def test_features_are_seen_again_where_they_moved_and_not_elsewhere() -> None:
    rng = np.random.default_rng(SEED)
    scene, other = (
        110.0 + 400.0 * cv2.GaussianBlur(rng.normal(0.0, 1.0, (480, 640)), (0, 0), 3.0) for _ in range(2)
    )
    now = np.roll(scene, (1, -2), axis=(0, 1))
    now[:, :320] = other[:, :320]
    camera = CameraModel("CAHV", (640, 480), np.zeros(3), [0, 0, 1], [600, 0, 319.5], [0, 600, 239.5])
    pictures = ((one + rng.normal(0.0, 2.0, one.shape)).astype(np.float32) for one in (scene, now))
    pixels, moved, sigma = seen_again(camera, *pictures)
    assert len(pixels) > 20
    assert (pixels[:, 0] > 300.0).all()
    assert np.abs((moved - [-2.0, 1.0]) / sigma[:, None]).max() < 5.0
