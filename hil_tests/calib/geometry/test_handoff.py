"""Geometric hand-off: against exact projection, and its covariances against drawn errors."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calib.errors import CalibError, NoHandoff, NoStereoPoint
from calib.files.mast_file import load_rig
from calib.geometry.covariance import (
    MOST_SIGMAS,
    RigCovariance,
    click_covariance,
    moved_rig,
    ray_gap,
    stored_covariance,
)
from calib.geometry.handoff import Joints, hand_off
from calib.geometry.parameters import parameter_names
from calib.geometry.rig import Rig
from calib.geometry.significance import Level
from calib.geometry.stereo import triangulate

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


def test_a_covariance_written_with_few_digits_is_one_still(repository: Path) -> None:
    believed = load_rig(repository / "configs/masts/rocky8_simulated.yaml").rig
    rounded = [[float(f"{value:.6g}") for value in row] for row in believed.fit["covariance"]]
    known = stored_covariance(replace(believed, fit={**believed.fit, "covariance": rounded}))
    assert known is not None and len(known.names) == len(rounded)


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
        (["mast.translation_m.x", "mast.translation_m.y"], [[1.0, 2.0], [2.0, 1.0]], "negative variance"),
        (["mast.translation_m.x", "mast.translation_m.y"], [[1.0, 0.5], [0.4, 1.0]], "not symmetric"),
    ):
        with pytest.raises(CalibError, match=words):
            stored(parameters=parameters, covariance=covariance)


def by_differences(
    rig: Rig, clicks_px: np.ndarray, at: Joints, there: Joints | None, known: RigCovariance
) -> tuple[np.ndarray, np.ndarray]:
    """Covariances of position (3, 3) and Hazcam pixels (4, 4) without the clicks', by central differences."""
    readings = [at] if there is None else [at, there]
    size = len(known.names)
    spread = np.zeros((size + 2 * len(readings),) * 2)
    spread[:size, :size] = known.covariance
    for i, reading in enumerate(readings):
        spread[size + 2 * i :, size + 2 * i :][:2, :2] = np.eye(2) * reading.sigma_rad**2

    def chain(step: np.ndarray) -> np.ndarray:
        believed = moved_rig(rig, known.names, step[:size]) if size else rig
        off = step[size:].reshape(-1, 2)
        joints = [(r.pan_rad + o[0], r.tilt_rad + o[1]) for r, o in zip(readings, off, strict=True)]
        eyes = (believed.camera_in_rover(name, *joints[0]) for name in PAIR)
        position = triangulate(*eyes, *clicks_px).position_m
        pixels = [believed.camera_in_rover(n, *joints[-1]).project(position)[0] for n in HAZCAMS]
        return np.concatenate([position, *pixels])

    root = np.linalg.cholesky(spread + 1e-24 * np.eye(len(spread))).T
    rates = np.array([(chain(0.1 * step) - chain(-0.1 * step)) / 0.2 for step in root])
    total = rates.T @ rates
    return total[:3, :3], total[3:, 3:]


SAME_AS_DIFFERENCES = 2e-4
"""Of the largest entry. The differences themselves, over a tenth of a sigma, are this good."""


@pytest.mark.parametrize("moves", [False, True])
def test_covariances_are_those_of_the_whole_chain_by_differences(
    rig: Rig, uncertain: RigCovariance, moves: bool
) -> None:
    at = replace(AT, sigma_rad=2e-4)
    there = Joints(0.14, -0.5, 3e-4) if moves else None
    exact = clicks(rig, PAIR, TARGET, at)
    done = hand_off(
        rig, PAIR, HAZCAMS, at, exact[0], exact[1], to_joints=there, sigma_px=0.3, calibration=uncertain
    )
    position, pixels = by_differences(rig, exact, at, there, uncertain)
    told = done.covariance_m2 - done.seen.covariance_m2
    assert np.abs(told - position).max() < SAME_AS_DIFFERENCES * np.abs(position).max()
    rates = np.concatenate(
        [rig.camera_in_rover(n, 0, 0).project_jacobian(done.seen.position_m)[1] for n in HAZCAMS]
    )
    told = done.joint_px2 - rates @ done.seen.covariance_m2 @ rates.T
    assert np.abs(told - pixels).max() < SAME_AS_DIFFERENCES * np.abs(pixels).max()


@pytest.mark.parametrize("calibrated", [False, True])
def test_clicks_whose_rays_pass_each_other_are_refused_with_gap_and_pixels(
    rig: Rig, uncertain: RigCovariance, calibrated: bool
) -> None:
    left, right = clicks(rig, PAIR, TARGET, AT)
    with pytest.raises(NoStereoPoint) as refused:
        hand_off(
            rig, PAIR, HAZCAMS, AT, left, right + np.array([0.0, 30.0]),
            calibration=uncertain if calibrated else None,
        )  # fmt: skip
    assert refused.value.code == "not_one_point"
    words = re.search(r"([\d.]+) sigma. The pixel of navcam_right is ([\d.]+) px off", str(refused.value))
    assert words is not None and float(words[1]) > 5.0
    # The eyes look nearly along the same line: 30 px down are 30 px across to a few per cent.
    assert float(words[2]) == pytest.approx(30.0, abs=0.6)
    # The other way along the epipolar line nothing is wrong: it is a point at another range.
    hand_off(rig, PAIR, HAZCAMS, AT, left, right + np.array([3.0, 0.0]))


@pytest.mark.parametrize(("added", "allowed_px"), [(PAIR, 4.0), (PAIR[1:], 3.0)], ids=["both", "right"])
def test_cameras_added_by_hand_to_a_calibrated_file_are_not_exact(
    rig: Rig, added: tuple[str, ...], allowed_px: float
) -> None:
    parts = [(n, p) for n in PAIR if n not in added for p in parameter_names(rig.cameras[n].model.kind)[:5]]
    names = ("mast.translation_m.z", *(f"cameras.{name}.{part}" for name, part in parts))
    known = RigCovariance(names, 1e-12 * np.eye(len(names)))
    left, right = clicks(rig, PAIR, TARGET, AT)
    hand_off(rig, PAIR, HAZCAMS, AT, left, right + np.array([0.0, allowed_px]), calibration=known)
    with pytest.raises(NoStereoPoint, match=rf"knows nothing of {' and '.join(added)}, explain"):
        hand_off(rig, PAIR, HAZCAMS, AT, left, right + np.array([0.0, allowed_px + 1.0]), calibration=known)


def test_a_rig_that_says_how_wrong_it_is_may_be(rig: Rig) -> None:
    """A principal point 4 px too low is explained by a calibration as unsure, and by no better one."""
    name = f"cameras.{PAIR[1]}.V.x"
    names = (name, f"cameras.{PAIR[0]}.V.x")  # the other one is known well
    left, right = clicks(rig, PAIR, TARGET, AT)
    wrong = moved_rig(rig, [name], np.array([4.0]))
    shift = clicks(wrong, PAIR, TARGET, AT)[1] - right
    assert abs(shift[1]) == pytest.approx(4.0, abs=0.3)
    hand_off(wrong, PAIR, HAZCAMS, AT, left, right, calibration=RigCovariance(names, np.diag([16.0, 1e-4])))
    with pytest.raises(NoStereoPoint, match="do not mean one point"):
        hand_off(
            wrong, PAIR, HAZCAMS, AT, left, right, calibration=RigCovariance(names, np.diag([1.0, 1e-4]))
        )


@pytest.mark.parametrize(
    ("calibrated", "draws"),
    [
        (False, 3_000),
        (True, 3_000),
        pytest.param(False, 10_000, marks=pytest.mark.long(4, "more draws; 3,000 are in the quick run")),
    ],
)
def test_one_good_pair_of_clicks_in_a_thousand_is_refused(
    rig: Rig, uncertain: RigCovariance, calibrated: bool, draws: int
) -> None:
    """Drawn from clicks and rigs that err as they are said to."""
    rng = np.random.default_rng(5)
    exact = clicks(rig, PAIR, TARGET, AT)
    known = uncertain.of(PAIR)
    from scipy.stats import norm  # slow to load, and every worker loads this file

    root = np.linalg.cholesky(known.covariance)
    at = (AT.pan_rad, AT.tilt_rad)
    allowed = click_covariance(
        rig, PAIR, *at, TARGET, sigma_px=0.2, calibration=known if calibrated else None
    )
    sigmas = []
    eyes = [rig.camera_in_rover(name, *at) for name in PAIR]
    for _ in range(draws):
        if calibrated:
            believed = moved_rig(rig, known.names, root @ rng.standard_normal(len(root)))
            eyes = [believed.camera_in_rover(name, *at) for name in PAIR]
        clicked = exact + rng.normal(0.0, 0.2, (2, 2))
        sigmas.append(ray_gap(triangulate(*eyes, *clicked), allowed).sigmas)
    assert pytest.approx(norm.isf(Level.STATED / 2), abs=1e-4) == MOST_SIGMAS
    # Of 10 (3) expected, 1 in 10^4 repetitions is outside; the mean square is 1 to 1.4 % (2.6 %).
    refused = int(np.sum(np.array(sigmas) > MOST_SIGMAS))
    assert (1 <= refused <= 24) if draws == 10_000 else refused <= 11
    assert np.mean(np.square(sigmas)) == pytest.approx(1.0, abs=6 * math.sqrt(2 / draws))


@pytest.mark.parametrize("off_px", [3.0, -5.0])
def test_how_far_a_click_is_off_the_epipolar_line_is_told_in_its_pixels(rig: Rig, off_px: float) -> None:
    """The eyes stand level, so that the line runs along the rows."""
    at = (AT.pan_rad, AT.tilt_rad)
    exact = clicks(rig, PAIR, TARGET, AT)
    eyes = [rig.camera_in_rover(name, *at) for name in PAIR]
    allowed = click_covariance(rig, PAIR, *at, TARGET, sigma_px=0.2)
    gap = ray_gap(triangulate(*eyes, exact[0], exact[1] + [0.0, off_px]), allowed)  # type: ignore[call-arg]
    assert gap.across_px == pytest.approx(abs(off_px), rel=0.05)
    assert gap.across_px / gap.across_sigma_px == pytest.approx(gap.sigmas)
