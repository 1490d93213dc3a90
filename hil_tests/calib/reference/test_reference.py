"""Results as they were, frozen: what a change of mechanism must not move.

Truth from outside judges the same code elsewhere; this set says that nothing moved at all. Where a change is
meant to move results, ``python -m hil_tests.calib.reference.test_reference GROUP ...`` writes those groups
anew (without a name all of them), and the commit says why.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from calib.adjust.result import FittedRig
from calib.adjust.uncertainty import pixel_covariance
from calib.calibrate.bench import fit_bench
from calib.calibrate.body import fit_body_pose
from calib.calibrate.paper import fit_paper
from calib.calibrate.survey import fit_joint
from calib.errors import NoHandoff
from calib.files.mast_file import load_rig
from calib.geometry.cahvor import CameraModel
from calib.geometry.covariance import RigCovariance
from calib.geometry.handoff import Joints, hand_off
from calib.geometry.pointing import solve
from calib.geometry.rig import Rig
from calib.survey.records import Sigma
from calib.targets.boards import Checkerboard, Corners, Dots
from calib.targets.corners import find_corners
from calib.targets.dots import find_dots
from hil_tests.calib.adjust.small_surveys import survey_of
from hil_tests.calib.calibrate.test_fit_bench import SERVO
from hil_tests.calib.geometry.test_opencv_lenses import LENSES, camera
from hil_tests.calib.matching import handed_over
from hil_tests.calib.targets.boards import NAVCAM_PX, pose, shoot
from hil_tests.calib.targets.boards import camera as board_camera
from hil_tests.support import random_masts
from hil_tests.support.sim_survey.bench import BenchPlan, simulate_bench

FOLDER = Path(__file__).resolve().parent
REPOSITORY = FOLDER.parents[2]
DATA = REPOSITORY / "hil_tests" / "data"

SAME = 1e-9
"""Of a result's sigma: what another order of the same arithmetic may move."""

STOPPED = {"paper": 1e-6, "paper 4": 1e-6, "servo": 1e-3}
"""Of a sigma: how far from its minimum a fit may stop. Another processor's rounding uses a third of it."""

ROUNDING = 1e-12
"""Of the size of a number that no estimate is in."""

CORNER_PX = 0.05
"""The sigma of a corner in a real picture."""

Values = dict[str, tuple[ArrayLike, ArrayLike]]
"""By name the numbers, and how far each may move."""


def exact(**numbers: ArrayLike) -> Values:
    """Numbers of geometry: each may move by rounding of the largest in its array's last axis."""
    out: Values = {}
    for name, value in numbers.items():
        array = np.asarray(value, dtype=np.float64)
        size = np.max(np.abs(array), axis=-1, keepdims=True, initial=0.0, where=np.isfinite(array))
        out[name] = array, ROUNDING * np.maximum(size, 1.0) if array.ndim else ROUNDING
    return out


def of_fit(fit: FittedRig, same: float) -> Values:
    """What a fit predicts in each camera, within some sigmas; these; and what it left out."""
    out: Values = {}
    for name, held in fit.rig.cameras.items():
        pixels, sigma = [], []
        for pan, tilt in ((0.0, 0.0), (-0.8, -0.3), (0.7, 0.2)):
            model = fit.rig.camera_in_rover(name, pan, tilt)
            spots = np.random.default_rng(1).uniform(0.1, 0.9, (6, 2)) * held.model.size_px
            rays = model.ray(spots)
            points = np.round(rays.origins_m + 3.0 * rays.directions, 1)
            seen, covariance = pixel_covariance(fit, name, pan, tilt, points)
            pixels.append(seen)
            sigma.append(np.sqrt(np.einsum("nii->ni", covariance)))
        out[f"{name} pixels"] = np.array(pixels), same * np.array(sigma)
        out[f"{name} sigmas"] = np.array(sigma), max(1e-6, same) * np.array(sigma)
    left = sum(o.kind == "image" for o in fit.outliers), sum(o.kind != "image" for o in fit.outliers)
    out["left out"] = left, 0.0
    out["chi-square"] = [fit.chi2, fit.degrees_of_freedom], same * np.maximum(1.0, np.abs(fit.chi2))
    out["rms"] = [*fit.rms_px.values(), *fit.check_rms_px.values()], same
    return out


def all_of(fits: Mapping[str, FittedRig]) -> Values:
    """The numbers of several fits."""
    return {
        f"{name} {key}": value
        for name, fit in fits.items()
        for key, value in of_fit(fit, STOPPED.get(name, SAME)).items()
    }


def true_rig() -> Rig:
    """The simulated rover's."""
    return load_rig(REPOSITORY / "configs" / "sim" / "rocky8.yaml").rig


def surveys() -> Values:
    """Surveys, jointly and the paper's way, of masts of four to eight numbers, and with noisy readings."""
    rig = true_rig()
    one = survey_of(rig, 1)
    noisy = survey_of(rig, 2, sigma=Sigma(0.001, 0.1, joint_rad=0.001))
    fits = {
        "joint": fit_joint(one),
        "joint 8": fit_joint(one, 8),
        "joint readings": fit_joint(noisy),
        "paper": fit_paper(one),
        "paper 4": fit_paper(one, 4),
    }
    return all_of(fits)


def benches() -> Values:
    """Benches without errors of the joints, with them and a bow, and with gross corners."""
    servo = BenchPlan(attitudes=12, bow_m=(0.002, -0.001), **SERVO)
    fits = {
        "plain": fit_bench(simulate_bench(3, BenchPlan(attitudes=10))),
        "servo": fit_bench(simulate_bench(1, servo)),
        "gross": fit_bench(simulate_bench(6, BenchPlan(attitudes=8, gross=0.015))),
    }
    return all_of(fits)


def bodies() -> Values:
    """A body pair's correction from hand-offs: one clean, one with a blunder."""
    rig = handed_over.plain_rig(true_rig())
    true = handed_over.moved_hazcams(
        rig, Rotation.from_rotvec([0.001, 0.005, -0.002]), (0.003, -0.002, 0.001)
    )
    out: Values = {}
    for seed in range(4):
        rng = np.random.default_rng(seed)
        made = handed_over.hand_offs(true, rig, handed_over.targets(rng, 24), rng)
        if seed % 2:
            made[5] = handed_over.with_found(made[5], handed_over.HAZCAMS[0], (8.0, -3.0))
        fit = fit_body_pose(rig, handed_over.HAZCAMS, made)
        sigma = np.sqrt(np.diag(fit.covariance))
        out[f"{seed} step"] = fit.step, SAME * sigma
        out[f"{seed} sigma"] = sigma, 1e-6 * sigma
        out[f"{seed} left out"] = [len(fit.outliers)], 0.0
    return out


def handoffs() -> Values:
    """Hand-offs from the Navcams, the head still or turned, the calibration exact or not."""
    rig, rng = true_rig(), np.random.default_rng(5)
    names = ("mast.rotation_rad.x", "mast.rotation_rad.y", "mast.translation_m.z", "cameras.navcam_left.C.y")
    known = RigCovariance(names, np.diag([2e-3, 2e-3, 1e-3, 5e-4]) ** 2)
    pair, pixels, search = ("navcam_left", "navcam_right"), [], []
    for number in range(60):
        at = Joints(rng.uniform(-0.3, 0.3), -0.55, 3e-4 if number % 3 else 0.0)
        there = Joints(at.pan_rad + 0.04, at.tilt_rad + 0.05, 3e-4) if number % 2 else None
        target = np.array([rng.uniform(2.0, 4.0), rng.uniform(-0.4, 0.4), -0.1])
        seen = [rig.camera_in_rover(n, at.pan_rad, at.tilt_rad).project(target)[0] for n in pair]
        clicks = np.array(seen) + rng.normal(0.0, 0.2, (2, 2))
        row, ellipses = np.full((4, 2), np.nan), np.full((4, 3), np.nan)
        try:
            done = hand_off(
                rig, pair, tuple(n for n in rig.cameras if n not in pair), at, *clicks,
                to_joints=there, calibration=known if number % 4 else None,
            )  # fmt: skip
        except NoHandoff:
            done = None
        for index, one in enumerate(done.pixels.values() if done else ()):
            if one is not None:
                row[index], ellipses[index] = one.pixel_px, one.search_px2[np.triu_indices(2)]
        pixels.append(row)
        search.append(ellipses)
    return exact(pixels=np.array(pixels)) | {"search": (np.array(search), 1e-9 * np.abs(search))}


def pointings() -> Values:
    """All solutions for 2,500 masts, as one number each; where two nearly meet, rounding counts more."""
    rng = np.random.default_rng(41)
    count, mixed, moved = np.zeros((3, 2_500))

    def mix(case: random_masts.MastCase, target: np.ndarray) -> tuple[int, float]:
        found = solve(case.mast, case.camera, target, case.pixel_px)
        return len(found), sum(np.sin(o.pan_rad) + 2.0 * np.sin(o.tilt_rad) + 0.1 * o.range_m for o in found)

    step = 1e-7
    for number in range(len(count)):
        case = random_masts.random_case(rng, number)
        count[number], mixed[number] = mix(case, case.target_in_rover_m)
        try:
            other = mix(case, case.target_in_rover_m * (1.0 + step))
            moved[number] = abs(other[1] - mixed[number]) if other[0] == count[number] else np.inf
        except ValueError:
            moved[number] = np.inf
    return {"solutions": (count, 0.0), "angles and ranges": (mixed, 10 * ROUNDING * (1.0 + moved / step))}


def of_lens(model: CameraModel, points_m: np.ndarray, pixels_px: np.ndarray) -> Values:
    """Pixels, rays and both derivatives of a camera."""
    pixels, jacobian, valid = model.project_jacobian(points_m)
    rays, d_directions, d_origins = model.ray_jacobian(pixels_px)
    return exact(
        pixels=pixels, jacobian=jacobian.reshape(-1, 6), directions=rays.directions, origins=rays.origins_m,
        d_directions=d_directions.reshape(-1, 6), d_origins=d_origins.reshape(-1, 6),
    ) | {"valid": (np.concatenate([valid, rays.valid]), 0.0)}  # fmt: skip


def lenses() -> Values:
    """JPL's twenty models at some of their vectors, and each of OpenCV's families."""
    out: Values = {}
    for path in sorted((DATA / "cahvor_vectors").glob("*.json")):
        content = json.loads(path.read_text())
        model, own = content["model"], {}
        for letter in "CAHVORE":
            own[letter] = model.get(letter)
        size = (model["width"], model["height"])
        kind, curve = (
            model["model_type"],
            {"cahvore_type": model.get("T", 0), "linearity": model.get("P", 1.0)},
        )
        points = np.array(content["forward"]["points_xyz"])[::17]
        pixels = np.array(content["inverse"]["pixels_xy"])[::17]
        found = of_lens(CameraModel(kind, size, **own, **curve), points, pixels)
        out |= {f"{path.stem} {key}": value for key, value in found.items()}
    rng = np.random.default_rng(7)
    for family in LENSES:
        model = camera(family, skew=3.0)
        local = rng.uniform([-0.6, -0.4, 1.0], [0.6, 0.4, 1.0], (15, 3)) * rng.uniform(0.5, 30.0, (15, 1))
        pixels = rng.uniform([-0.5, -0.5], np.array(model.size_px) - 0.5, (15, 2))
        found = of_lens(model, local @ model.rotation + model.C, pixels)
        out |= {f"{family} {key}": value for key, value in found.items()}
    return out


def detections() -> Values:
    """Corners of OpenCV's real pictures, and dots of drawn ones."""
    out: Values = {}
    for path in sorted((DATA / "opencv_stereo").glob("*.jpg")):
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        assert image is not None
        found = find_corners(Checkerboard(10, 7, 0.025), image.astype(np.uint8))
        assert isinstance(found, Corners)
        out[path.stem] = found.pixels_px, SAME * CORNER_PX
    for seed, tilt in enumerate(((0.0, 0.0), (35.0, 20.0), (50.0, 100.0))):
        shot = shoot(np.random.default_rng(seed), board_camera(NAVCAM_PX), pose(2.5 + seed, tilt))
        dots = find_dots(shot.image, shot.board)
        assert isinstance(dots, Dots)
        out[f"dots {seed}"] = dots.pixels_px, SAME * CORNER_PX
    return out


GROUPS: dict[str, Callable[[], Values]] = {
    made.__name__: made for made in (surveys, benches, bodies, handoffs, pointings, lenses, detections)
}


def stored(group: str) -> Mapping[str, Any]:
    """A group's numbers as they were."""
    with np.load(FOLDER / f"{group}.npz") as file:
        return dict(file)


@pytest.mark.parametrize("group", GROUPS)
def test_results_are_what_they_were(group: str) -> None:
    was, now = stored(group), GROUPS[group]()
    assert set(now) == set(was)
    moved = []
    for name, (value, most) in now.items():
        value, before = np.asarray(value, dtype=np.float64), was[name]
        assert value.shape == before.shape, name
        off = np.abs(value - before)
        same = (off <= most) | (np.isnan(value) & np.isnan(before))
        if not same.all():
            beyond = np.max(np.where(same, 0.0, off / np.maximum(most, 1e-300)))
            moved.append(f"{name}: {np.count_nonzero(~same)} of {same.size}, {beyond:.3g} times what may be")
    assert not moved, "\n".join(moved)


def freeze(groups: list[str]) -> None:
    """Write the numbers of groups, or of all."""
    for group in groups or list(GROUPS):
        numbers = {name: np.asarray(value, dtype=np.float64) for name, (value, _) in GROUPS[group]().items()}
        np.savez_compressed(FOLDER / f"{group}.npz", **numbers)  # type: ignore[arg-type]


if __name__ == "__main__":
    freeze(sys.argv[1:])
