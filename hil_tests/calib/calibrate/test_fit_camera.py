"""One camera from fixed points: starts from a rough focal length alone, wide lenses, what is refused."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calib.adjust.robust import SurveyNotFitted
from calib.adjust.solver import covariance_of, minimise
from calib.adjust.terms import ImageTerm, lens_notes
from calib.calibrate.starts import agreeing, cameras
from calib.calibrate.starts.agreeing import Agreed
from calib.calibrate.starts.cameras import References, fit_mast
from calib.geometry.cahvor import CameraModel
from calib.geometry.parameters import parameter_part
from calib.geometry.rig import Rig, RigCamera
from calib.geometry.rigid import Rigid
from hil_tests.support.sim_survey.plan import BOARD

ROWS, COLUMNS = np.divmod(np.arange(100), 10)
PIXEL = 2e-3
"""Recovery on data without noise: what lenses are usually like pulls a little on what a board sees badly."""


def boards(
    model: CameraModel, ranges_m: tuple[float, ...], seed: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points, exact pixels and image numbers of boards all over the picture of a camera."""
    rng = np.random.default_rng(seed)
    points, pixels = [], []
    images: list[np.ndarray] = []
    width, height = model.size_px
    for range_m in ranges_m:
        for x, y in ((0.3, 0.3), (0.7, 0.3), (0.3, 0.7), (0.7, 0.7), (0.5, 0.5)):
            rays = model.ray([(x * width, y * height)])
            axes = np.column_stack([*np.linalg.svd(rays.directions)[2][1:], rays.directions[0]])
            axes[:, 0] *= np.linalg.det(axes)
            turn = axes @ Rotation.from_rotvec(rng.uniform(-0.5, 0.5, 3)).as_matrix()
            places = (
                BOARD.dots_in_board_m(ROWS, COLUMNS) @ turn.T + rays.origins_m + range_m * rays.directions
            )
            seen, valid = model.project(places)
            inside = valid & (seen > 0).all(axis=1) & (seen < [width - 1, height - 1]).all(axis=1)
            if inside.sum() < 20:
                continue
            points.append(places[inside])
            pixels.append(seen[inside])
            images.append(np.full(int(inside.sum()), len(images)))
    return np.concatenate(points), np.concatenate(pixels), np.concatenate(images)


def fit_camera(
    points: np.ndarray, pixels: np.ndarray, images: np.ndarray, *, sigma_px: float = 0.1, **camera_is: Any
) -> Agreed:
    """The fit of a camera to points of images that each belong to a board of their own, its frame theirs."""
    terms = []
    for image in np.unique(images):
        mine = images == image
        rows, name = np.arange(mine.sum()), str(image)
        terms.append(
            ImageTerm(
                name, "camera", ("points", name), None, 0.0, 0.0, rows, rows, points[mine], pixels[mine],
                np.full(len(rows), sigma_px), np.ones(len(rows), dtype=bool),
            )
        )  # fmt: skip
    boards = {t.board: Rigid.identity() for t in terms}
    return cameras.fit_camera(terms, boards, expected_px=sigma_px, **camera_is)


def model_of(fit: Agreed) -> CameraModel:
    return fit.fit.state.cameras["camera"]


def farthest_px(fit: Agreed) -> float:
    """The largest residual of a coordinate."""
    model = model_of(fit)
    return max(float(np.abs(model.project(t.in_board_m)[0] - t.pixels_px).max()) for t in fit.images)


RANGES_M = {"pancam": (5.0, 10.0), "navcam": (3.0, 6.0), "hazcam": (1.0, 2.0)}


def fitted(model: CameraModel, name: str, factor: float, noise_px: float = 0.0, **options: object) -> Agreed:
    points, pixels, images = boards(model, RANGES_M[name.split("_")[0]], 1)
    pixels = pixels + noise_px * np.random.default_rng(2).standard_normal(pixels.shape)
    focal = factor * float(np.linalg.norm(np.cross(model.A, model.H)))
    return fit_camera(
        points,
        pixels,
        images,
        kind=model.kind,
        size_px=model.size_px,
        focal_px=focal,
        **options,  # type: ignore[arg-type]
    )


@pytest.mark.parametrize("factor", [0.8, 1.0, 1.25])
@pytest.mark.parametrize("name", ["pancam_left", "navcam_right", "hazcam_left"])
def test_a_rough_focal_length_is_enough(true_rig: Rig, name: str, factor: float) -> None:
    model = true_rig.cameras[name].model
    found = fitted(model, name, factor)
    assert all(t.keep.all() for t in found.images)
    assert farthest_px(found) < PIXEL


def test_an_upside_down_camera_starts_as_well(true_rig: Rig) -> None:
    model = true_rig.cameras["navcam_left"].model
    turned = CameraModel(
        model.kind, model.size_px, model.C, model.A,
        1023 * model.A - model.H, 767 * model.A - model.V, model.O, model.R,
    )  # fmt: skip
    assert farthest_px(fitted(turned, "navcam", 1.1)) < PIXEL


def test_covariance_of_a_camera_is_its_scatter(true_rig: Rig) -> None:
    model = true_rig.cameras["navcam_left"].model
    points, pixels, images = boards(model, RANGES_M["navcam"], 1)
    squares = []
    for seed in range(30):
        noisy = pixels + 0.1 * np.random.default_rng(seed).standard_normal(pixels.shape)
        found = fit_camera(points, noisy, images, kind="CAHVOR", size_px=model.size_px, focal_px=1290.0)
        error, sigma = model_of(found).C - model.C, covariance_of(found.fit.normal.matrix)[:3, :3]
        squares.append(float(error @ np.linalg.solve(sigma, error)))
    assert abs(np.mean(squares) - 3) < 4 * np.sqrt(2 * 3 / 30)


@pytest.mark.parametrize("kind", ["CAHV", "CAHVOR"])
def test_a_pinhole_camera_can_be_fitted_without_a_lens(true_rig: Rig, kind: str) -> None:
    known = true_rig.cameras["navcam_left"].model
    pinhole = CameraModel("CAHV", known.size_px, known.C, known.A, known.H, known.V)
    points, pixels, images = boards(pinhole, RANGES_M["navcam"], 1)
    found = fit_camera(points, pixels, images, kind=kind, size_px=known.size_px, focal_px=1200.0)  # type: ignore[arg-type]
    assert model_of(found).kind == kind
    assert farthest_px(found) < PIXEL


def test_images_of_other_boards_are_left_out(true_rig: Rig) -> None:
    model = true_rig.cameras["navcam_left"].model
    points, pixels, images = boards(model, RANGES_M["navcam"], 1)
    pixels = pixels.copy()
    pixels[images == 2] += (60.0, -35.0)
    found = fit_camera(points, pixels, images, kind="CAHVOR", size_px=model.size_px, focal_px=1350.0)
    assert [t.name for t in found.images if not t.keep.any()] == ["2"]
    assert all(t.keep.all() for t in found.images if t.name != "2")


def test_one_board_is_not_enough(true_rig: Rig) -> None:
    model = true_rig.cameras["navcam_left"].model
    points, pixels, images = boards(model, RANGES_M["navcam"], 1)
    one = images == 0
    with pytest.raises(SurveyNotFitted, match="1 boards"):
        fit_camera(
            points[one], pixels[one], images[one], kind="CAHVOR", size_px=model.size_px, focal_px=1290.0
        )


def test_pixels_of_nothing_are_refused(true_rig: Rig) -> None:
    model = true_rig.cameras["navcam_left"].model
    points, pixels, images = boards(model, RANGES_M["navcam"], 1)
    shuffled = np.random.default_rng(0).permutation(pixels)
    with pytest.raises(SurveyNotFitted, match="placement"):
        fit_camera(points, shuffled, images, kind="CAHVOR", size_px=model.size_px, focal_px=1290.0)


def test_no_image_away_from_the_reference_fits_no_mast() -> None:
    with pytest.raises(SurveyNotFitted, match="no image"):
        fit_mast([], {}, References({}, {}))


def test_a_ratio_of_polynomials_settles_on_one_navcam_and_its_open_coefficients_are_named(
    true_rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """k1 and k4 growing together hardly change such a picture: 310 steps, while 10 of each were usual."""
    model = true_rig.cameras["navcam_left"].model
    points, pixels, images = boards(model, RANGES_M["navcam"], 1)
    pixels = pixels + 0.1 * np.random.default_rng(2).standard_normal(pixels.shape)
    steps = []

    def counted(*given: Any, **options: Any) -> Any:
        steps.append(minimise(*given, **options))
        return steps[-1]

    monkeypatch.setattr(agreeing, "minimise", counted)
    focal_px = 1.1 * float(np.linalg.norm(np.cross(model.A, model.H)))
    found = fit_camera(points, pixels, images, kind="OPENCV8", size_px=model.size_px, focal_px=focal_px)
    assert steps[-1].settled
    assert max(one.steps for one in steps) < 60
    assert found.typical_px < 0.11
    sigma = np.sqrt(np.diag(covariance_of(found.fit.normal.matrix)))[parameter_part("OPENCV8", "D")]
    rig = replace(true_rig, cameras={"navcam_left": RigCamera("head", model_of(found))})
    (note,) = lens_notes(rig, {"cameras": {"navcam_left": {"distortion": sigma}}})
    assert re.match(r"the survey hardly shows (k\d, )*k6 of navcam_left, so what lenses are usually", note)
