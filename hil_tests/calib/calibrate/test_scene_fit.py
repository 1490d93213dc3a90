"""What a still scene tells of a rig: pixels by formulas of this file's own, bumps put in by hand."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from calib.calibrate.scene.features import Feature
from calib.calibrate.scene.fit import fit_scene, white_px
from calib.calibrate.scene.places import Sights
from calib.calibrate.scene.terms import PRIOR, SceneView, terms_of
from calib.errors import NoCorrection
from calib.geometry.cahvor import CameraModel
from calib.geometry.rig import Mast, Rig, RigCamera

SIZE = (1024, 768)
FOCAL_PX = 1280.0
NOISE_PX = 0.1
EYES_M = {"eye_left": np.array([0.06, -0.1, -0.08]), "eye_right": np.array([0.06, 0.1, -0.08])}
MAST_M = np.array([0.2, 0.0, -1.1])


def believed() -> Rig:
    """Two ideal eyes, 0.2 m apart, on an upright mast."""
    cx, cy = (SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2
    cameras = {
        name: RigCamera("head", CameraModel("CAHV", SIZE, C, [1, 0, 0], [cx, FOCAL_PX, 0], [cy, 0, FOCAL_PX]))
        for name, C in EYES_M.items()
    }
    return Rig("test", Mast(MAST_M, np.zeros(3)), cameras, {"eye": ("eye_left", "eye_right")})


def turn(axis: int, angle_rad: float) -> np.ndarray:
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    i, j = [(1, 2), (2, 0), (0, 1)][axis]
    matrix = np.eye(3)
    matrix[i, i] = matrix[j, j] = c
    matrix[i, j], matrix[j, i] = -s, s
    return matrix


def pixels_of(
    points: np.ndarray,
    camera: str,
    pan: float,
    tilt: float,
    bump: dict[str, np.ndarray],
    focal: dict[str, float],
) -> np.ndarray:
    """Pixels of rover points by the head's two turns and a pinhole; a bumped eye turns where it is."""
    head = turn(2, pan) @ turn(1, tilt)
    in_head = (points - MAST_M) @ head
    small = bump.get(camera, np.zeros(3))
    bumped = turn(2, small[2]) @ turn(1, small[1]) @ turn(0, small[0])
    x, y, z = ((in_head - EYES_M[camera]) @ bumped).T
    f = FOCAL_PX * (1.0 + focal.get(camera, 0.0))
    return np.stack([f * y / x + (SIZE[0] - 1) / 2, f * z / x + (SIZE[1] - 1) / 2], axis=1)


def scene(
    seed: int,
    bump: dict[str, np.ndarray] | None = None,
    focal: dict[str, float] | None = None,
    pan_harmonic: tuple[float, float] = (0.0, 0.0),
    pans: int = 8,
    count: int = 120,
    repeat: float = 5e-5,
    play: float = 0.0,
    moved: tuple[int, float] | None = None,
    round_by: float = 2 * np.pi,
    twice: float = 0.0,
    astride: float = 0.0,
) -> tuple[list[SceneView], list[Feature]]:
    """Rests all round at two tilts, and features on rough ground, each seen where the true rig shows it.

    From the rest that ``moved`` names on, the rover stands so many metres farther ahead and turned by a
    hundredth of that, in radians, about its forward axis. With ``play`` each other rest is reached from
    larger angles of pan. ``pan_harmonic`` and ``twice`` are what pan reads wrong once and twice a turn.
    With ``astride`` the same pan reads by that more at the lower tilt, half a hundredth off round angles.
    """
    rng = np.random.default_rng(seed)
    reads = [
        (pan + (0.005 + np.copysign(astride / 2, -0.3 - tilt) if astride else 0.0), tilt)
        for tilt in (-0.15, -0.45)
        for pan in np.linspace(-round_by / 2, round_by / 2, pans, endpoint=False)
    ]
    views = [
        SceneView(
            f"{name} {pose}",
            name,
            np.zeros((2, 2), np.float32),
            pan,
            tilt,
            pose,
            ((-1.0 if pose % 2 else 1.0) if play else 0.0, 0.0),
        )
        for pose, (pan, tilt) in enumerate(reads)
        for name in EYES_M
    ]
    true = []
    for pose, (pan, tilt) in enumerate(reads):
        wrong = pan_harmonic[0] * np.cos(pan) + pan_harmonic[1] * np.sin(pan) + (pose % 2 - 0.5) * play
        wrong += twice * np.sin(2 * pan)
        true.append((pan + wrong + rng.normal(0, repeat), tilt + rng.normal(0, repeat)))
    bearing, far = rng.uniform(-np.pi, np.pi, count), rng.uniform(1.8, 15.0, count)
    points = np.stack([far * np.cos(bearing), far * np.sin(bearing), rng.normal(0, 0.15, count)], axis=1)
    features = []
    by = 0.0 if moved is None else moved[1]
    after = (points - [by, 0.0, 0.0]) @ turn(0, 0.01 * by)
    shown = [
        pixels_of(
            after if moved and view.pose >= moved[0] else points,
            view.camera,
            *true[view.pose],
            bump or {},
            focal or {},
        )
        for view in views
    ]
    ahead = [
        ((points - MAST_M) @ (turn(2, view.pan_rad) @ turn(1, view.tilt_rad)))[:, 0] > 0.5 for view in views
    ]
    for point in range(count):
        seen = [
            number
            for number in range(len(views))
            if ahead[number][point]
            and (np.abs(shown[number][point] - np.array([511.5, 383.5])) < [500, 370]).all()
        ][:6]
        if len(seen) < 2:
            continue
        pixels = np.array([shown[number][point] for number in seen])
        pixels[1:] += rng.normal(0, NOISE_PX, pixels[1:].shape)
        covariances = np.array([np.eye(2) * (0.02**2 if at == 0 else NOISE_PX**2) for at in range(len(seen))])
        features.append(Feature(tuple(seen), pixels, covariances))
    return views, features


def test_a_bumped_eye_is_found_and_nothing_else_is_moved() -> None:
    bump = np.array([1.2e-3, -1.8e-3, 0.9e-3])
    views, features = scene(1, {"eye_left": bump})
    fit = fit_scene(believed(), views, features)
    assert fit.taken[0] in ("eye_left turned in the head", "eye_right turned in the head")
    # which eye moved pictures hardly tell: turning both is the joints' zero; the difference they do
    turns = {
        eye: np.array([fit.values[fit.names.index(f"cameras.{eye}.turn.{axis}")] for axis in "xyz"])
        for eye in EYES_M
        if f"cameras.{eye}.turn.x" in fit.names
    }
    between = turns.get("eye_left", np.zeros(3)) - turns.get("eye_right", np.zeros(3))
    np.testing.assert_allclose(between, bump, atol=1.5e-4)
    assert fit.rms_px[1] < 0.6 * fit.rms_px[0]
    assert fit.predicted_px[1] < 0.6 * fit.predicted_px[0]
    assert 0.8 < fit.scale < 1.3 or fit.scale == 1.0


def test_a_refocused_eye_is_told_by_its_focal_length() -> None:
    views, features = scene(2, focal={"eye_right": 2e-3})
    fit = fit_scene(believed(), views, features)
    value = fit.values[fit.names.index("cameras.eye_right.scale")]
    sigma = np.sqrt(
        fit.covariance[fit.names.index("cameras.eye_right.scale")][fit.names.index("cameras.eye_right.scale")]
    )
    assert abs(value - 2e-3) < 4 * sigma
    assert sigma < 2e-4


def test_an_encoder_off_its_centre_is_told_by_pictures_all_round() -> None:
    views, features = scene(3, pan_harmonic=(2e-3, -1e-3))
    fit = fit_scene(believed(), views, features)
    assert "pan reads wrong once a turn" in fit.taken
    found = [fit.values[fit.names.index(f"joints.pan.{name}")] for name in ("c1", "s1")]
    np.testing.assert_allclose(found, [2e-3, -1e-3], atol=3e-4)


BUMP = {"eye_left": np.array([1.2e-3, -1.8e-3, 0.9e-3])}


def test_an_encoder_wrong_seen_from_five_pans_beside_a_turned_eye_is_told_too() -> None:
    views, features = scene(1, BUMP, pan_harmonic=(1.5e-3, -1.5e-3), pans=5, round_by=3.0, count=400)
    fit = fit_scene(believed(), views, features)
    assert "pan reads wrong once a turn" in fit.taken
    off = [
        (fit.values[at] - {"c1": 1.5e-3, "s1": -1.5e-3}[name[-2:]]) / np.sqrt(fit.covariance[at, at])
        for at, name in enumerate(fit.names)
        if name.startswith("joints.pan")
    ]
    assert np.abs(off).max() < 4.0


@pytest.mark.parametrize("astride", [0.0, 0.001])
def test_a_joint_wrong_at_too_few_readings_to_tell_how_is_refused_by_name(astride: float) -> None:
    views, features = scene(1, BUMP, twice=3e-3, pans=5, round_by=3.0, count=400, astride=astride)
    with pytest.raises(NoCorrection, match=r"at its 5 readings pan is off by .* mrad rms") as refused:
        fit_scene(believed(), views, features)
    assert refused.value.code == "errs_by_reading"


def test_features_that_a_wrong_eye_sees_beyond_infinity_have_a_place() -> None:
    """Two eyes 0.2 m apart turned towards each other by 30 mrad see lines of sight diverge by 38 px."""
    rig, nothing = believed(), np.zeros((2, 2), np.float32)
    views = [SceneView(name, name, nothing, 0.0, 0.0, 0) for name in EYES_M]
    pixels = np.array([[500.0, 380.0], [538.0, 380.0]])
    sights = Sights(
        [Feature((0, 1), pixels, np.array([np.eye(2)] * 2))], [view.model(rig) for view in views], MAST_M
    )
    models = [view.model(rig) for view in views]
    off, _, _ = sights.off(models, sights.start(models))
    assert np.abs(off).max() < 0.1


def test_a_feature_behind_a_camera_is_named_and_never_a_number() -> None:
    views, features = scene(5, BUMP, count=250)
    views.append(replace(views[0], name="behind", pan_rad=views[0].pan_rad + np.pi, pose=views[-1].pose + 1))
    seen = next(feature for feature in features if feature.views[0] == 0)
    lost = Feature((0, len(views) - 1), seen.pixels_px[:2], seen.covariances_px2[:2])
    fit = fit_scene(believed(), views, [*features, lost])
    x, y = lost.pixels_px[0]
    named = (
        f"the feature at ({x:.0f}, {y:.0f}) of eye_left 0, behind: no place is before all of these cameras"
    )
    assert named in fit.outliers
    assert fit.taken == fit_scene(believed(), views, features).taken


def test_a_rig_that_is_as_believed_is_left_as_it_is() -> None:
    views, features = scene(4)
    with pytest.raises(NoCorrection, match="show no correction") as refused:
        fit_scene(believed(), views, features)
    assert refused.value.code == "not_significant"


def test_a_feature_that_moved_is_named_and_not_used() -> None:
    views, features = scene(5, {"eye_left": np.array([0.0, 1.5e-3, 0.0])}, count=250)
    wrong = replace(
        features[7],
        pixels_px=features[7].pixels_px + np.array([[0, 0]] + [[3.0, 4.0]] * (len(features[7].views) - 1)),
    )
    fit = fit_scene(believed(), views, [*features[:7], wrong, *features[8:]])
    x, y = wrong.pixels_px[0]
    assert any(f"({x:.0f}, {y:.0f})" in sentence and "sigma off" in sentence for sentence in fit.outliers)
    assert len(fit.outliers) < 0.03 * len(features)


def test_rests_that_scatter_more_than_was_told_are_not_taken_for_a_wrong_rig() -> None:
    views, features = scene(8, repeat=1e-3)
    with pytest.raises(NoCorrection) as refused:
        fit_scene(believed(), views, features)
    assert refused.value.code == "not_significant"


def test_a_told_scatter_that_equals_what_eyes_may_turn_by_is_no_other_scatter() -> None:
    views, features = scene(5, {"eye_left": np.array([0.012, -0.018, 0.009])}, count=60)
    noisier = [replace(f, covariances_px2=f.covariances_px2 / 9.0) for f in features]
    scales = [fit_scene(believed(), views, noisier, PRIOR["turn"] * by).scale for by in (1.0 - 1e-7, 1.0)]
    assert 4.0 < scales[0] < 16.0
    assert scales[1] == pytest.approx(scales[0], rel=1e-6)


def test_an_axis_with_play_is_told_by_rests_from_both_sides() -> None:
    views, features = scene(9, play=3e-3, count=250)
    fit = fit_scene(believed(), views, features)
    assert fit.taken == ("pan has play",)
    assert abs(fit.values[0] - 3e-3) < 4 * np.sqrt(fit.covariance[0, 0])
    assert fit.rms_px[1] < 0.5 * fit.rms_px[0]


def test_a_rover_that_moved_between_two_rests_is_told_with_the_place() -> None:
    views, features = scene(10, moved=(8, 0.02), count=250)
    with pytest.raises(
        NoCorrection, match=r"tilt -0.450 rad the rover moved by .* one side alone"
    ) as refused:
        fit_scene(believed(), views, features)
    assert refused.value.code == "changed_halfway"


def test_what_few_rests_cannot_tell_is_not_asked() -> None:
    views, _ = scene(6)
    words = [term.words for term in terms_of(believed(), views)]
    assert "pan reads wrong once a turn" in words
    assert "tilt reads wrong once a turn" not in words
    few = [term.words for term in terms_of(believed(), [view for view in views if view.pose < 4])]
    assert "pan reads wrong once a turn" not in few


def test_too_few_features_are_refused_with_what_would_help() -> None:
    views, features = scene(7)
    with pytest.raises(
        NoCorrection, match=r"11 features .* where 12 are expected: pictures that overlap"
    ) as refused:
        fit_scene(believed(), views, features[:11])
    assert refused.value.code == "too_few"


def test_a_sigma_of_features_in_pixels_is_per_axis() -> None:
    def feature(*sigmas_px: float) -> Any:
        return SimpleNamespace(covariances_px2=np.array([np.eye(2), np.diag(np.square(sigmas_px))]))

    assert white_px([feature(0.3, 0.3)]) == pytest.approx(0.3)
    assert white_px([feature(0.1, 0.7), feature(1.0, 1.0)]) == pytest.approx((0.5 + 1.0) / 2)
