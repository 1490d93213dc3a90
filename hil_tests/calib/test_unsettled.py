"""A fit that was stopped before it settled is told as none, by every fitter; one that can settle does."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calib.adjust import robust
from calib.adjust import solver as least_squares
from calib.adjust.terms import ImageTerm
from calib.calibrate import body as fit_body_pose
from calib.calibrate import survey as fit_joint
from calib.calibrate.starts import agreeing
from calib.calibrate.starts.agreeing import Agreed
from calib.calibrate.starts.cameras import References, fit_mast
from calib.errors import CalibError
from calib.geometry.cahvor import CameraModel
from calib.geometry.rig import Rig
from calib.geometry.rigid import FloatArray, Rigid
from calib.matching import search as one_point
from hil_tests.calib.adjust.small_surveys import survey_of
from hil_tests.calib.calibrate.test_fit_camera import boards, fit_camera
from hil_tests.calib.matching.handed_over import HAZCAMS, hand_offs, moved_hazcams, plain_rig, targets
from tools.flight import poses as fit_poses


def test_a_fit_whose_equations_have_a_factor_at_a_large_damping_only_stays_where_it_is() -> None:
    class Unsolvable:
        def normal(self, x: FloatArray) -> least_squares.Normal:
            return least_squares.Normal(1.0, np.array([[1.0, 2.0], [2.0, 1.0]]), np.zeros(2))

        def cost(self, x: FloatArray) -> float:
            return 1.0

        def stepped(self, x: FloatArray, step: FloatArray) -> FloatArray:
            return x + step

    start = np.zeros(2)
    assert least_squares.minimise(Unsolvable(), start).state is start


@pytest.mark.parametrize("curve", [-0.5, -0.9, -0.98, -3.0])
def test_a_fit_with_large_residuals_settles(curve: float) -> None:
    """Undamped steps go from an error e to ``curve`` times e (Dennis and Schnabel 1983, section 10.2)."""

    class Parabola:
        def normal(self, x: FloatArray) -> least_squares.Normal:
            residual, slope = self._residual(x), np.array([[1.0], [2.0 * curve * x[0] + 1.0]])
            return least_squares.Normal(self.cost(x), slope.T @ slope, slope.T @ residual)

        def cost(self, x: FloatArray) -> float:
            return float(self._residual(x) @ self._residual(x))

        def stepped(self, x: FloatArray, step: FloatArray) -> FloatArray:
            return x + step

        @staticmethod
        def _residual(x: FloatArray) -> FloatArray:
            return np.array([x[0] + 1.0, curve * x[0] ** 2 + x[0] - 1.0])

    found = least_squares.minimise(Parabola(), np.array([0.1]))
    assert found.settled
    assert found.steps < 30
    assert found.state[0] == pytest.approx(0.0, abs=1e-5)


@pytest.fixture
def stopped(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Stops the last fit of modules after one step (those that only lead to a start go on)."""

    def stop(*modules: object) -> None:
        def minimise(*arguments: object, steps: int = 200, **options: object) -> object:
            last = steps >= 100
            return least_squares.minimise(*arguments, steps=1 if last else steps, **options)  # type: ignore

        for module in modules:
            monkeypatch.setattr(module, "minimise", minimise)

    return stop


def test_a_camera(true_rig: Rig, stopped: Callable[..., None]) -> None:
    stopped(agreeing)
    model = true_rig.cameras["navcam_left"].model
    points, pixels, images = boards(model, (3.0, 6.0), 1)
    pixels = pixels + np.random.default_rng(4).normal(0.0, 0.1, pixels.shape)
    focal_px = float(np.linalg.norm(np.cross(model.A, model.H)))
    with pytest.raises(robust.SurveyNotFitted, match="settled"):
        fit_camera(points, pixels, images, kind=model.kind, size_px=model.size_px, focal_px=focal_px)


@pytest.mark.parametrize("parameters", [4, 6])
def test_a_mast(navcams: Rig, stopped: Callable[..., None], parameters: int) -> None:
    fitted_mast(navcams, parameters)
    stopped(agreeing)
    with pytest.raises(robust.SurveyNotFitted, match="settled"):
        fitted_mast(navcams, parameters)


def test_a_mast_is_judged_by_where_its_last_fit_ended(navcams: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    fit = fitted_mast(navcams, 6, expected_px=0.3)

    def minimise(*arguments: object, steps: int = 200, **options: object) -> object:
        return least_squares.minimise(*arguments, steps=steps if steps >= 100 else 0, **options)  # type: ignore

    monkeypatch.setattr(agreeing, "minimise", minimise)  # what leads there does not
    late = fitted_mast(navcams, 6, expected_px=0.3)
    assert all(t.keep.any() for t in late.images)
    assert np.abs(late.fit.state.mast - fit.fit.state.mast).max() < 1e-6


def fitted_mast(rig: Rig, parameters: int, **options: Any) -> Agreed:
    """The mast fitted to images of random points at many joint angles."""
    rng, terms = np.random.default_rng(3), []
    for index in range(8):
        joints = (float(rng.uniform(-0.6, 0.6)), float(rng.uniform(-0.5, 0.0)))
        camera = rig.camera_in_rover("navcam_left", *joints)
        rays = camera.ray(rng.uniform(100, 700, (12, 2)))
        points = rays.origins_m + rng.uniform(2.0, 5.0, 12)[:, None] * rays.directions
        pixels = camera.project(points)[0] + rng.normal(0.0, 0.2, (12, 2))
        rows, name = np.arange(12), f"i{index}"
        terms.append(
            ImageTerm(
                name, "navcam_left", ("points", name), index, *joints, rows, rows, points, pixels,
                np.ones(12), np.ones(12, dtype=bool),
            )
        )  # fmt: skip
    at = (0.0, -0.2)
    references = References({"navcam_left": rig.camera_in_rover("navcam_left", *at)}, {"navcam_left": at})
    return fit_mast(terms, {t.board: Rigid.identity() for t in terms}, references, parameters, **options)


def test_a_survey_in_one_piece(navcams: Rig, stopped: Callable[..., None]) -> None:
    stopped(robust)
    with pytest.raises(robust.SurveyNotFitted, match="did not settle"):
        fit_joint.fit_joint(survey_of(navcams, 2))


def test_a_mast_from_camera_models(navcams: Rig, stopped: Callable[..., None]) -> None:
    rng = np.random.default_rng(1)
    pan, tilt = rng.uniform(-1.0, 1.0, 8), rng.uniform(-0.6, 0.3, 8)
    models: list[CameraModel] = []
    for p, t in zip(pan, tilt, strict=True):
        model = navcams.camera_in_rover("navcam_left", float(p), float(t))
        models.append(shaken(model, rng))
    fit_poses.fit_poses(models, pan, tilt, parameters=8)
    stopped(fit_poses)
    with pytest.raises(fit_poses.PosesTooFew, match="did not settle"):
        fit_poses.fit_poses(models, pan, tilt, parameters=8)


def shaken(model: object, rng: np.random.Generator) -> object:
    """The model turned by some 5 mrad and moved by some 5 mm."""
    turn = Rotation.from_rotvec(rng.normal(0.0, 5e-3, 3)).as_matrix()
    return model.moved(Rigid(turn, rng.normal(0.0, 5e-3, 3)))  # type: ignore[attr-defined]


def test_a_body_pose(true_rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    rig, rng = plain_rig(true_rig), np.random.default_rng(1)
    true = moved_hazcams(rig, Rotation.from_rotvec([3e-3, -4e-3, 2e-3]), np.array([0.002, 0.001, -0.003]))
    made = hand_offs(true, rig, targets(rng, 24), rng)
    monkeypatch.setattr(fit_body_pose, "_STEPS", 1)
    with pytest.raises(CalibError, match="did not settle") as refused:
        fit_body_pose.fit_body_pose(rig, HAZCAMS, made)
    assert getattr(refused.value, "code", "") == "not_settled"


def test_one_point_of_many_pixels(navcams: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    target = np.array([3.0, 0.2, -0.3])
    cameras = [navcams.camera_in_rover(name, 0.0, -0.3) for name in navcams.cameras]
    seen = [(c, c.project(target)[0], 0.01 * np.eye(2)) for c in cameras]
    find: Callable[[], one_point.OnePoint | None] = partial(
        one_point.one_point, far(target), 25.0 * np.eye(3), seen, 0.1
    )
    found = find()
    assert found is not None and np.linalg.norm(found.position_m - target) < 0.05
    monkeypatch.setattr(one_point, "STEPS", 1)
    assert find() is None


def far(target_m: FloatArray) -> FloatArray:
    """A believed place 1 m behind the target."""
    return target_m + np.array([1.0, 0.0, 0.0])
