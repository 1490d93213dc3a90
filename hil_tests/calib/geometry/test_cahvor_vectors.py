"""Camera models against vectors that JPL's own library made: 20 models of flown and synthetic cameras.

`hil_tests/data/cahvor_vectors` holds points with pixels and Jacobians, and pixels with rays and Jacobians.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from calib.geometry.cahvor import CameraModel
from calib.geometry.rigid import unit_vector

PIXEL_PX = 1e-9
DIRECTION = 1e-11
ORIGIN_M = 1e-11
JACOBIAN = 1e-6  # of the norm of the reference matrix
DIFFERENCE = 1e-8  # of the norm, for fourth-order differences of our own rays
NAMES = (
    "cahvor_INSIGHT_IDC_D001L0040_600081076",
    "cahvor_M20_MCAM_Z_LEFT_Z034",
    "cahvor_M20_MCAM_Z_RIGHT_Z110",
    "cahvor_M20_WATSON",
    "cahvor_MSL_NAV_LEFT_A_sn216_1024",
    "cahvor_MSL_NAV_LEFT_A_sn216_256ds4",
    "cahvor_MSL_NAV_LEFT_B_sn215_1024",
    "cahvor_MSL_NAV_LEFT_B_sol3000",
    "cahvor_MSL_NAV_RIGHT_B_NRB_701383954",
    "cahvore_M20_HAZFLA",
    "cahvore_M20_HAZRR",
    "cahvore_M20_HELI_RTE_CAM",
    "cahvore_M20_NAVCAM_LEFT_NLF_0014",
    "cahvore_M20_NAVCAM_LEFT_NLF_0100",
    "cahvore_M20_NAVCAM_LEFT_NLF_0670",
    "cahvore_M20_NAVCAM_RIGHT_NRF_0731",
    "cahvore_M20_NAVL",
    "cahvore_SYN_type1_perspective",
    "cahvore_SYN_type3_general_p0.37",
    "cahvore_VW_test_hazcam_p0.37",
)


class Reference(NamedTuple):
    """One file: the model as this project holds it, and the file's numbers."""

    model: CameraModel
    printed: dict[str, list[float]]
    forward: dict[str, np.ndarray]
    inverse: dict[str, np.ndarray]


@pytest.fixture(scope="module", params=NAMES)
def reference(request: pytest.FixtureRequest, reference_data: Path) -> Reference:
    """Every model in turn."""
    text = (reference_data / "cahvor_vectors" / f"vectors_{request.param}.json").read_text()
    content = json.loads(text)
    model = content["model"]

    numbers = [
        {k: np.array(v) for k, v in content[part].items() if k != "note"} for part in ("forward", "inverse")
    ]
    letters = {letter: model.get(letter) for letter in "CAHVORE"}
    camera = CameraModel(
        model["model_type"], (model["width"], model["height"]),
        cahvore_type=model.get("T", 0), linearity=model.get("P", 1.0), **letters,
    )  # fmt: skip
    return Reference(camera, model["as_published"], *numbers)


def norms(matrices: np.ndarray) -> np.ndarray:
    """Frobenius norms of matrices (n, r, c)."""
    return np.sqrt((matrices**2).sum(axis=(1, 2)))


def test_every_vector_file_is_named_here(reference_data: Path) -> None:
    found = {p.stem.removeprefix("vectors_") for p in (reference_data / "cahvor_vectors").glob("*.json")}
    assert found == set(NAMES)


def test_pixels_are_those_of_the_reference(reference: Reference) -> None:
    pixels, valid = reference.model.project(reference.forward["points_xyz"])
    assert valid.all()
    assert np.abs(pixels - reference.forward["pixels_xy"]).max() <= PIXEL_PX


def test_rays_are_those_of_the_reference(reference: Reference) -> None:
    rays = reference.model.ray(reference.inverse["pixels_xy"])
    assert rays.valid.all()
    assert np.abs(rays.directions - reference.inverse["ray_dir"]).max() <= DIRECTION
    assert np.abs(rays.origins_m - reference.inverse["ray_origin"]).max() <= ORIGIN_M


def test_pixel_jacobian_is_that_of_the_reference(reference: Reference) -> None:
    pixels, jacobian, valid = reference.model.project_jacobian(reference.forward["points_xyz"])
    expected = reference.forward["jacobian"]
    assert valid.all()
    assert np.abs(pixels - reference.forward["pixels_xy"]).max() <= PIXEL_PX
    assert (norms(jacobian - expected) / norms(expected)).max() <= JACOBIAN


def test_direction_jacobian_is_that_of_the_reference(reference: Reference) -> None:
    """For CAHVOR, the library's own matrix has a part along the ray, which no unit vector's derivative has.

    (``cmod_cahvor_2d_to_3d`` inverts the derivative of r' = r + mu lambda without the length that it has
    normalised away; differences of the library's own rays show no such part.) It is taken out first.
    """
    rays, jacobian, _ = reference.model.ray_jacobian(reference.inverse["pixels_xy"])
    expected = reference.inverse["jacobian_dir"]
    directions = reference.inverse["ray_dir"][:, :, None]
    along = directions * (directions * expected).sum(axis=1, keepdims=True)
    if reference.model.kind == "CAHVORE":
        assert (norms(along) / norms(expected)).max() <= JACOBIAN
    else:
        expected = expected - along
    assert (norms(jacobian - expected) / norms(expected)).max() <= JACOBIAN
    assert np.abs(rays.directions - reference.inverse["ray_dir"]).max() <= DIRECTION


def test_ray_jacobians_are_the_differences_of_rays(reference: Reference) -> None:
    model, pixels = reference.model, reference.inverse["pixels_xy"]
    _, d_direction, d_origin = model.ray_jacobian(pixels)
    step_px = 0.0005 * max(model.size_px)
    for column, unit in enumerate(np.eye(2)):
        stencil = [model.ray(pixels + k * step_px * unit) for k in (-2, -1, 1, 2)]
        weights = np.array([1.0, -8.0, 8.0, -1.0]) / (12.0 * step_px)
        directions = sum(w * s.directions for w, s in zip(weights, stencil, strict=True))
        origins = sum(w * s.origins_m for w, s in zip(weights, stencil, strict=True))
        miss = np.abs(d_direction[:, :, column] - directions).max(axis=1)
        assert (miss / norms(d_direction)).max() <= DIFFERENCE
        # Against the direction's: one metre of the origin counts as much as one radian.
        assert (np.abs(d_origin[:, :, column] - origins).max(axis=1) / norms(d_direction)).max() <= DIFFERENCE


def test_a_point_along_the_ray_of_a_pixel_comes_back_to_it(reference: Reference) -> None:
    pixels = reference.inverse["pixels_xy"]
    rays = reference.model.ray(pixels)
    for range_m in (0.3, 1.0, 7.0, 1e2, 1e4):
        again, valid = reference.model.project(rays.origins_m + range_m * rays.directions)
        assert valid.all()
        assert np.abs(again - pixels).max() <= PIXEL_PX


def test_printed_vectors_are_made_unit_vectors(reference: Reference) -> None:
    for letter, printed in reference.printed.items():
        assert np.abs(unit_vector(printed) - getattr(reference.model, letter)).max() <= 1e-15
