"""Geometric hand-off: against exact projection, and its covariances against drawn errors."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calib.camera_parameters import parameter_names
from calib.errors import CalibError, NoHandoff
from calib.handoff import Joints, hand_off
from calib.mast import Rig
from calib.rig_covariance import RigCovariance, moved_rig, stored_covariance
from calib.store import load_rig

AT = Joints(0.1, -0.55)
TARGET = np.array([2.3, 0.2, -0.1])
PAIR = ("navcam_left", "navcam_right")
HAZCAMS = ("hazcam_left", "hazcam_right")


@pytest.fixture(scope="module")
def rig(repository: Path) -> Rig:
    """The true rig of the simulated rover."""
    return load_rig(repository / "configs/sim/rocky8.yaml").rig


def clicks(rig: Rig, pair: tuple[str, str], target: np.ndarray, at: Joints) -> np.ndarray:
    """Exact pixels of a target in both cameras."""
    return np.array([rig.camera_in_rover(n, at.pan_rad, at.tilt_rad).project(target)[0] for n in pair])


@pytest.mark.parametrize("source", ["navcam", "pancam"])
def test_exact_clicks_land_exactly_in_every_camera(rig: Rig, source: str) -> None:
    pair = rig.stereo[source]
    target = np.array([5.0, 0.5, -0.3])
    at, there = Joints(0.1, -0.2), Joints(0.15, -0.25)
    to = tuple(name for name in rig.cameras if name not in pair)
    left, right = clicks(rig, pair, target, at)
    done = hand_off(rig, pair, to, at, left, right, to_joints=there)
    assert np.linalg.norm(done.seen.position_m - target) < 1e-9
    for name in to:
        exact, _ = rig.camera_in_rover(name, there.pan_rad, there.tilt_rad).project(target)
        width, height = rig.cameras[name].model.size_px
        inside = 0 <= exact[0] <= width - 1 and 0 <= exact[1] <= height - 1
        predicted = done.pixels[name]
        assert (predicted is not None) == inside, name
        if predicted is not None:
            assert np.abs(predicted.pixel_px - exact).max() < 1e-7
        else:
            assert done.reasons[name]


def drawn(
    rig: Rig, known: RigCovariance, sigma_px: float, sigma_rad: float, moves: bool, draws: int
) -> np.ndarray:
    """Pixels (draws, 2, 2) minus exact ones, of hand-offs by a rig, readings and clicks that err."""
    rng = np.random.default_rng(3)
    there = Joints(0.14, -0.5) if moves else AT
    exact = clicks(rig, PAIR, TARGET, AT)
    wanted = clicks(rig, HAZCAMS, TARGET, there)
    root = np.linalg.cholesky(known.covariance) if known.names else np.zeros((0, 0))
    off = []
    for _ in range(draws):
        believed = moved_rig(rig, known.names, root @ rng.standard_normal(len(known.names)))
        first, second = rng.normal(0.0, sigma_rad, (2, 2)) if sigma_rad else np.zeros((2, 2))
        read = Joints(AT.pan_rad + first[0], AT.tilt_rad + first[1])
        then = Joints(there.pan_rad + second[0], there.tilt_rad + second[1]) if moves else None
        left, right = exact + rng.normal(0.0, sigma_px, (2, 2))
        done = hand_off(believed, PAIR, HAZCAMS, read, left, right, to_joints=then)
        off.append([done.pixels[n].pixel_px for n in HAZCAMS])  # type: ignore[union-attr]
    return np.array(off) - wanted


@pytest.fixture(scope="module")
def uncertain(rig: Rig) -> RigCovariance:
    """A made-up calibration covariance with correlations, of mast and of four cameras."""
    names = ["mast.rotation_rad.x", "mast.rotation_rad.y", "mast.translation_m.z"]
    sigma = [2e-3, 2e-3, 1e-3]
    for camera in (*PAIR, *HAZCAMS):
        for part in parameter_names(rig.cameras[camera].model.kind)[:5]:
            names.append(f"cameras.{camera}.{part}")
            sigma.append(5e-4)
    mixed = np.random.default_rng(8).normal(size=(len(names), len(names)))
    correlation = mixed @ mixed.T + 10 * np.eye(len(names))
    d = 1 / np.sqrt(np.diag(correlation))
    return RigCovariance(tuple(names), np.outer(d * sigma, d * sigma) * correlation)


@pytest.mark.parametrize(("sigma_rad", "moves"), [(0.0, False), (3e-4, False), (3e-4, True)])
@pytest.mark.parametrize("calibrated", [False, True])
def test_the_search_ellipse_is_that_of_drawn_errors(
    rig: Rig, uncertain: RigCovariance, sigma_rad: float, moves: bool, calibrated: bool
) -> None:
    known = uncertain if calibrated else RigCovariance((), np.zeros((0, 0)))
    left, right = clicks(rig, PAIR, TARGET, AT)
    there = Joints(0.14, -0.5, sigma_rad) if moves else None
    done = hand_off(
        rig, PAIR, HAZCAMS, replace(AT, sigma_rad=sigma_rad), left, right,
        to_joints=there, sigma_px=0.3, calibration=known if calibrated else None,
    )  # fmt: skip
    off = drawn(rig, known, 0.3, sigma_rad, moves, 500)
    for index, name in enumerate(HAZCAMS):
        predicted = done.pixels[name]
        assert predicted is not None
        distances = np.einsum(
            "ni,ij,nj->n", off[:, index], np.linalg.inv(predicted.search_px2), off[:, index]
        )
        # The mean of 500 squared distances is 2, sigma 0.09: a covariance off by a factor of 1.2 fails.
        assert abs(distances.mean() - 2.0) < 0.32, name
        if not calibrated and sigma_rad == 0.0:
            np.testing.assert_array_equal(predicted.covariance_px2, predicted.search_px2)


def test_a_turn_of_the_whole_mast_does_not_touch_a_hand_off_on_the_head(rig: Rig) -> None:
    """What source and destination share cancels."""
    known = RigCovariance(tuple(f"mast.rotation_rad.{a}" for a in "xyz"), np.eye(3) * 1e-4)
    left, right = clicks(rig, PAIR, TARGET, AT)
    done = hand_off(rig, PAIR, ("pancam_left",), AT, left, right, calibration=known, sigma_px=0.1)
    seen = done.pixels["pancam_left"]
    assert seen is not None
    np.testing.assert_allclose(seen.search_px2, seen.covariance_px2, rtol=1e-5)
    assert done.covariance_m2[2, 2] > 10 * done.seen.covariance_m2[2, 2]


def test_too_far_too_near_and_unseen_are_refused_by_name(rig: Rig) -> None:
    def refused(target: np.ndarray, to: tuple[str, ...], sigma_px: float = 0.2) -> str:
        left, right = clicks(rig, PAIR, target, AT)
        with pytest.raises(NoHandoff) as caught:
            hand_off(rig, PAIR, to, AT, left, right, sigma_px=sigma_px)
        return caught.value.code

    ray = rig.camera_in_rover(PAIR[0], AT.pan_rad, AT.tilt_rad).ray([511.5, 383.5])
    at = [ray.origins_m + r * ray.directions for r in (0.15, 2.0, 600.0)]
    assert refused(at[0], HAZCAMS) == "too_near"
    assert refused(at[2], HAZCAMS) == "too_far"
    left = rig.camera_in_rover(PAIR[0], AT.pan_rad, AT.tilt_rad).ray([15.0, 383.5])
    assert refused(left.origins_m + 2.0 * left.directions, ("pancam_right",)) == "not_seen"


def test_a_covariance_that_does_not_fit_its_rig_is_refused(rig: Rig) -> None:
    def stored(**fit: object) -> RigCovariance | None:
        return stored_covariance(replace(rig, fit=fit))

    assert stored() is None
    good = stored(parameters=["mast.translation_m.x"], covariance=[[4.0]])
    assert good is not None and good.covariance[0, 0] == 4.0
    for parameters, covariance, words in (
        (["mast.height"], [[1.0]], "mast.height"),
        (["mast.translation_m.x"], [[1.0, 2.0]], "1 rows"),
        (["mast.translation_m.x"], [["a"]], "1 rows"),
        (["mast.translation_m.x"], [[float("nan")]], "1 rows"),
        ("mast", [[1.0]], "list of names"),
    ):
        with pytest.raises(CalibError, match=words):
            stored(parameters=parameters, covariance=covariance)
