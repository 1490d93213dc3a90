"""Derivatives of a camera's pixels to its own parameters, against differences of the projection."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calib.geometry.cahvor import CameraModel
from calib.geometry.parameters import parameter_names, parameter_part, predict, stepped
from calib.geometry.rigid import Rigid

RELATIVE = 2e-7
"""Of central differences with these steps."""

H, V = [610.0, 0.0, 318.0], [0.9, 603.0, 241.0]
O_AXIS = Rotation.from_rotvec([0.012, -0.02, 0.0]).apply([0.0, 0.0, 1.0])  # fmt: skip
PLACE = Rigid(Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix(), np.array([0.3, -0.1, -1.4]))


def camera(name: str) -> CameraModel:
    """A camera at an odd place with all its letters at work."""
    base = {"size_px": (640, 480), "C": [0, 0, 0], "A": [0, 0, 1], "H": H, "V": V}
    if name == "CAHV":
        return CameraModel("CAHV", **base).moved(PLACE)  # type: ignore[arg-type]
    if name == "CAHVOR":
        return CameraModel("CAHVOR", **base, O=O_AXIS, R=[0.0, -0.12, 0.05]).moved(PLACE)  # type: ignore[arg-type]
    line = {"type 1": 1.0, "type 2": 0.0, "type 3": 0.37, "sine": -0.4}[name]
    number = {"type 1": 1, "type 2": 2}.get(name, 3)
    lens = {"O": O_AXIS, "R": [0.0, -0.03, 0.01], "E": [0.004, -0.002, 0.006]}
    return CameraModel("CAHVORE", **base, **lens, cahvore_type=number, linearity=line).moved(PLACE)  # type: ignore[arg-type]


NAMES = ("CAHV", "CAHVOR", "type 1", "type 2", "type 3", "sine")


def seen(model: CameraModel) -> np.ndarray:
    x, y = np.meshgrid(np.linspace(5, 630, 7), np.linspace(5, 470, 6))
    rays = model.ray(np.stack([x.ravel(), y.ravel()], axis=-1))
    ranges = np.linspace(0.5, 9.0, x.size)[:, None]
    return np.asarray(rays.origins_m + ranges * rays.directions)


@pytest.mark.parametrize("name", NAMES)
def test_predicted_pixels_are_the_projection(name: str) -> None:
    model = camera(name)
    points = seen(model)
    px, d_points, valid = model.project_jacobian(points)
    predicted = predict(model, points)
    assert valid.all() and predicted.valid.all()
    assert np.abs(predicted.pixels_px - px).max() < 1e-9
    assert np.abs(predicted.d_points - d_points).max() < 1e-9 * np.abs(d_points).max()


@pytest.mark.parametrize("name", NAMES)
def test_derivatives_to_the_parameters_are_those_of_differences(name: str) -> None:
    model = camera(name)
    points = seen(model)
    d_step = predict(model, points).d_step
    names = parameter_names(model.kind)
    assert d_step.shape == (len(points), 2, len(names))
    for index, parameter in enumerate(names):
        step = np.zeros(len(names))
        step[index] = 1e-3 if parameter[0] in "HV" else 1e-6
        ahead, _ = stepped(model, step).project(points)
        behind, _ = stepped(model, -step).project(points)
        difference = (ahead - behind) / (2 * step[index])
        scale = np.abs(difference).max()
        assert scale > 0, parameter
        assert np.abs(d_step[..., index] - difference).max() < RELATIVE * scale, parameter


@pytest.mark.parametrize("name", NAMES)
def test_no_combination_of_parameters_is_a_gauge(name: str) -> None:
    model = camera(name)
    d_step = predict(model, seen(model)).d_step.reshape(-1, len(parameter_names(model.kind)))
    values = np.linalg.svd(d_step / np.linalg.norm(d_step, axis=0), compute_uv=False)
    assert values[-1] > 1e-7 * values[0]


def test_a_point_behind_the_camera_is_not_a_number() -> None:
    model = camera("CAHVOR")
    predicted = predict(model, np.array([model.C - model.A, model.C + model.A]))
    assert predicted.valid.tolist() == [False, True]
    assert np.isnan(predicted.d_step[0]).all() and np.isfinite(predicted.d_step[1]).all()


def test_parts_of_a_step_follow_the_names() -> None:
    names = parameter_names("CAHVORE")
    assert len(names) == 18
    for letter in "CAHVORE":
        assert all(name[0] == letter for name in names[parameter_part("CAHVORE", letter)])
