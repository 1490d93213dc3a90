"""The paper's calibration (section III): each camera at one joint setting, then the mast, each step exact.

Cameras are fitted to images of purpose ``camera``, set-ups and boards taken from the station as they are. The
mast is fitted to images of purpose ``mast`` with those cameras (eq. (9)), which it then carries to the head.
All dots weigh the same; errors of the station show as residuals. The covariance is that of this estimator
(``calib.calibrate.paper``). Dots that disagree with the rest of their image are left out beforehand
(``calib.calibrate.starts.stray_dots``).

Written with normal equations (k cameras, m mast, s station: boards, set-ups, prisms and joints), the
station's noise moves boards and set-ups, the cameras follow, and the mast follows both:

    dk = -Nkk⁻¹ (Nks ds + dots),    dm = -Nmm⁻¹ (Nms ds + Nmk dk + dots),

k from the camera images, m from the mast images, ds with the covariance that prisms and tapes give.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from calib.adjust.adjustment import Adjustment
from calib.adjust.outliers import Outlier
from calib.adjust.result import Calibration, ImageResiduals, rig_of
from calib.adjust.robust import SurveyNotFitted
from calib.adjust.solver import covariance_of
from calib.adjust.terms import ImageTerm, lens_knowledge, lens_notes, with_kept
from calib.adjust.uncertainty import (
    check_rms,
    image_residuals,
    open_directions,
    rms_by_camera,
    sigma_by_key,
    station_residuals,
)
from calib.adjust.unknowns import MAST, Estimate
from calib.calibrate.starts.mast import MastNotFitted, fit_mast
from calib.calibrate.starts.stray_dots import without_stray_dots
from calib.calibrate.starts.survey import Start, at_setting, camera_from_points, mast_views, start_values
from calib.geometry.cahvor import CameraModel
from calib.geometry.parameters import parameter_names, parameter_part, predict, stepped
from calib.geometry.rig import gimbal, gimbal_rates, mast_of
from calib.geometry.rigid import FloatArray, rigid_rates, tangents
from calib.survey.records import Survey


class _Block(NamedTuple):
    """Weighted Jacobian (2n, k) of an image on the unknowns (k,) of the two steps."""

    jacobian: FloatArray
    columns: np.ndarray


class TwoSteps:
    """Normal equations of the two steps at the solution, cameras in the rover frame at their references."""

    def __init__(
        self,
        problem: Adjustment,
        state: Estimate,
        cameras: Mapping[str, CameraModel],
        reference_rad: Mapping[str, tuple[float, float]],
    ) -> None:
        self.problem, self.state = problem, state
        self.cameras, self.reference_rad = cameras, reference_rad

    def covariance(self, camera_images: set[str]) -> tuple[FloatArray, FloatArray]:
        """Covariance of cameras in the head (or rover) and mast: all of it, and for noise of dots alone."""
        problem = self.problem
        total = len(problem.names)
        first, second = np.zeros((total, total)), np.zeros((total, total))
        for term in problem.images:
            if term.keep.any():
                block = self._block(term)
                at = np.ix_(block.columns, block.columns)
                (first if term.name in camera_images else second)[at] += block.jacobian.T @ block.jacobian
        k, m = problem.unknowns.of_kinds("camera"), problem.at(MAST)
        s = np.setdiff1d(np.arange(total), np.concatenate([k, m]))
        camera_matrix = first[np.ix_(k, k)] + np.diag(problem.weak[k])
        for name, model in self.cameras.items():
            if model.kind != "CAHV":
                _, rows = lens_knowledge(model)
                part = np.searchsorted(k, problem.at(("camera", name)))
                camera_matrix[np.ix_(part, part)] += rows.T @ rows
        by_dots_k = covariance_of(camera_matrix)
        k_by_s = -by_dots_k @ first[np.ix_(k, s)]
        by_dots_m = covariance_of(second[np.ix_(m, m)], problem.weak[m]) if len(m) else np.zeros((0, 0))
        m_by_k = -by_dots_m @ second[np.ix_(m, k)]
        m_by_s = -by_dots_m @ second[np.ix_(m, s)] + m_by_k @ k_by_s
        follow = np.concatenate([np.eye(len(k)), m_by_k])
        dots = follow @ by_dots_k @ follow.T
        dots[len(k) :, len(k) :] += by_dots_m
        by_s = np.concatenate([k_by_s, m_by_s])
        to_head = self._to_head(np.concatenate([k, m]))
        station = by_s @ self._station(s) @ by_s.T
        return to_head @ (dots + station) @ to_head.T, to_head @ dots @ to_head.T

    def _station(self, s: np.ndarray) -> FloatArray:
        """Covariance of set-ups, boards, prisms and joints from the station and what is known beforehand."""
        problem = self.problem
        matrix = np.diag(problem.weak)
        for point in problem.station:
            if not point.keep:
                continue
            block = problem.station_blocks(self.state, [point])[0]
            matrix[np.ix_(block.columns, block.columns)] += block.jacobian.T @ block.jacobian
        for what, block in problem.known(self.state):
            if what.kind is not None:
                matrix[np.ix_(block.columns, block.columns)] += block.jacobian.T @ block.jacobian
        return covariance_of(matrix[np.ix_(s, s)])

    def _block(self, term: ImageTerm) -> _Block:
        """One image: what its pixels do as the camera (at its reference), mast, board and joints move."""
        problem, state, keep = self.problem, self.state, term.keep
        board = state.rover_from_board[term.board]
        points = board.points(term.in_board_m[keep])
        camera = self.cameras[term.camera]
        columns = [problem.at(("camera", term.camera))]
        if term.attitude is None:
            seen = predict(camera, points)
            parts, in_rover = [seen.d_step], seen.d_points
        else:
            now = gimbal(state.mast, term.pan_rad, term.tilt_rad)
            then = gimbal(state.mast, *self.reference_rad[term.camera])
            turn = then.rotation @ now.rotation.T
            carried = (points - now.translation_m) @ turn.T + then.translation_m
            seen = predict(camera, carried)
            in_rover = seen.d_points @ turn
            free = problem.mast_free
            parts = [
                seen.d_step,
                gimbal_rates(seen.d_points, carried, then, free) - gimbal_rates(in_rover, points, now, free),
            ]
            columns.append(problem.at(MAST))
            if problem.joint_rad > 0:
                parts.append(-gimbal_rates(in_rover, points, now, np.array([8, 9])))
                columns.append(problem.at(("attitude", term.attitude)))
        parts.append(rigid_rates(in_rover, points, board.translation_m))
        columns.append(problem.at(("board", term.board)))
        jacobian = np.concatenate(parts, axis=2) / term.sigma_px[keep, None, None]
        return _Block(jacobian.reshape(2 * len(points), -1), np.concatenate(columns))

    def _to_head(self, rig: np.ndarray) -> FloatArray:
        """(k, k), of the ``rig``'s numbers: from steps of the mast and of cameras in the rover frame to those
        of head cameras."""
        matrix = np.eye(len(self.problem.names))
        for name, at in self.reference_rad.items():
            part = self.problem.at(("camera", name))
            columns = np.concatenate([part, self.problem.at(MAST)])
            count = len(part)
            nominal, in_rover = self.state.cameras[name], self.cameras[name]
            scale = np.full(len(columns), 1e-6)
            for letter in "HV":
                scale[parameter_part(nominal.kind, letter)] = 1e-3
            for index, column in enumerate(columns):
                step = np.zeros(len(columns))
                step[index] = scale[index]
                ends = [self._in_head(in_rover, at, nominal, sign * step, count) for sign in (1.0, -1.0)]
                matrix[part, column] = (ends[0] - ends[1]) / (2 * scale[index])
        return np.asarray(matrix[np.ix_(rig, rig)])

    def _in_head(
        self,
        in_rover: CameraModel,
        at: tuple[float, float],
        nominal: CameraModel,
        step: FloatArray,
        count: int,
    ) -> FloatArray:
        """The step of the head camera that a step of camera and mast makes."""
        numbers = self.state.mast.copy()
        numbers[self.problem.mast_free] += step[count:]
        head = gimbal(numbers, *at)
        model = stepped(in_rover, step[:count])
        parts = {letter: getattr(model, letter) @ head.rotation for letter in "AHVO"}
        out = np.zeros(len(parameter_names(nominal.kind)))
        out[parameter_part(nominal.kind, "C")] = (model.C - head.translation_m) @ head.rotation - nominal.C
        for letter in "HV":
            out[parameter_part(nominal.kind, letter)] = parts[letter] - getattr(nominal, letter)
        for letter in "AO":
            if letter in nominal.letters:
                out[parameter_part(nominal.kind, letter)] = tangents(getattr(nominal, letter)) @ parts[letter]
        if "R" in nominal.letters:
            out[parameter_part(nominal.kind, "R")] = (model.R - nominal.R)[1:]
        if "E" in nominal.letters:
            out[parameter_part(nominal.kind, "E")] = model.E - nominal.E
        if "D" in nominal.letters:
            out[parameter_part(nominal.kind, "D")] = model.distortion - nominal.distortion
        return out


SAME_SETTING_RAD = 1e-9
"""Camera images whose joint angles differ by more are carried to one setting by the mast, once known."""

REFUSED = 12.0
"""A mast that leaves its images this many times the residual to expect is refused (not an upright one)."""


def fit_paper(survey: Survey, mast_parameters: int = 6) -> Calibration:
    """Fit cameras, then the mast, as the paper does.

    Parameters
    ----------
    survey
        The measurements; head cameras need images of purpose ``camera`` at one joint setting each.
    mast_parameters
        4 for a mast that is taken as upright (the paper's Table V), 6 for the paper's, 8 for two skew axes.

    Raises
    ------
    SurveyNotFitted
        If the survey does not determine a camera or the mast, or no start leads near the noise.
    """
    began = time.perf_counter()
    survey, strays = without_stray_dots(survey)
    fit = _fit(survey, mast_parameters, began)
    return replace(fit, outliers=(*fit.outliers, *strays))


def _fit(survey: Survey, mast_parameters: int, began: float) -> Calibration:
    """Cameras, then the mast, once."""
    from_here = start_values(survey, mast_parameters, only_camera_images=True)
    purposes = {i.name: i.purpose for i in survey.images}
    cameras = dict(from_here.in_rover)
    mast = from_here.estimate.mast
    left_out = {t.name for t in from_here.images if t.board in from_here.bent}
    camera_images = _at_reference(survey, from_here, purposes, left_out)
    mast_images = [
        t
        for t in from_here.images
        if purposes[t.name] == "mast" and t.camera in from_here.reference_rad and t.name not in left_out
    ]
    of_camera = {t.name: t.camera for t in from_here.images}
    doubtful = {n: from_here.limits_px[of_camera[n]] for n in from_here.doubtful if purposes[n] == "camera"}
    if mast_images:
        mast, doubtful = _mast_of(from_here, cameras, mast_images, mast_parameters, doubtful)
        if _carry(from_here, camera_images, mast) is not None:
            cameras |= _cameras_again(survey, from_here, camera_images, mast, set(doubtful))
            mast, doubtful = _mast_of(from_here, cameras, mast_images, mast_parameters, doubtful)
    fitted = {t.name for t in (*camera_images, *mast_images)} - set(doubtful)
    skipped = {t.name for t in from_here.images if t.name not in fitted}
    state = replace(from_here.estimate, cameras=_to_head(cameras, from_here, mast), mast=mast)
    wrong = {o.name for o in from_here.blunders}
    problem = Adjustment(
        with_kept(from_here.images, skipped),
        [replace(p, keep=False) if p.name in wrong else p for p in from_here.station],
        state,
        mast_parameters=mast_parameters if from_here.reference_rad else 0,
        prisms_cad_m=survey.prisms_in_rover_m,
        prism_cad_m=survey.sigma.prism_cad_m,
        joint_rad=survey.sigma.joint_rad,
    )
    parts = TwoSteps(problem, state, cameras, from_here.reference_rad)
    covariance, mast_alone = parts.covariance({t.name for t in camera_images})
    images = image_residuals(survey, problem, state, from_here.images, from_here.checks)
    in_sigmas = [
        np.sum((i.residuals_px[i.used] / i.sigma_px[i.used, None]) ** 2) for i in images if i.used.any()
    ]
    count = sum(2 * int(i.used.sum()) for i in images)
    rig, values = rig_of(survey, state), problem.values(state, "mast", "camera")
    place = {number: i for i, number in enumerate(problem.unknowns.of_kinds("camera", "mast").tolist())}
    order = [place[number] for number in problem.unknowns.of_kinds("mast", "camera").tolist()]
    covariance = covariance[np.ix_(order, order)]
    sigma = sigma_by_key(rig, tuple(values), covariance)
    notes = [*from_here.notes, *_bent_notes(from_here), *lens_notes(rig, sigma)]
    return Calibration(
        method="paper",
        mast_parameters=mast_parameters,
        rig=rig,
        parameter_names=tuple(values),
        estimate=np.array(list(values.values())),
        covariance=covariance,
        sigma=sigma,
        rms_px=rms_by_camera(images),
        check_rms_px=check_rms(survey, state, images),
        outliers=(*from_here.blunders, *_left_out(images, {**dict.fromkeys(left_out, np.nan), **doubtful})),
        degenerate=open_directions(problem, mast_alone),
        notes=tuple(notes),
        chi2=float(sum(in_sigmas)),
        degrees_of_freedom=float(count - len(values)),
        chi2_probability=float("nan"),
        images=images,
        station=station_residuals(problem, state),
        rover_from_station=state.rover_from_station,
        rover_from_board=state.rover_from_board,
        prisms_in_rover_m=state.prisms_in_rover_m,
        seconds=time.perf_counter() - began,
    )


def _at_reference(
    survey: Survey, from_here: Start, purposes: Mapping[str, str], left_out: set[str]
) -> list[ImageTerm]:
    """Camera images taken at their camera's reference setting."""
    return [
        t
        for t in from_here.images
        if purposes[t.name] == "camera"
        and t.name not in left_out
        and at_setting(t, from_here.reference_rad.get(t.camera, (0.0, 0.0)), survey.sigma.joint_rad)
    ]


def _mast_of(
    from_here: Start,
    cameras: Mapping[str, CameraModel],
    mast_images: list[ImageTerm],
    mast_parameters: int,
    doubtful: Mapping[str, float],
) -> tuple[FloatArray, dict[str, float]]:
    """The mast, and the doubtful images with those that do not fit it; by name the limit they failed, px."""
    views = mast_views(mast_images, cameras, from_here.reference_rad, from_here.estimate.rover_from_board)
    rough = from_here.estimate.mast.copy()
    if mast_parameters == 4:
        rough[3:5] = 0.0
    expected = REFUSED / 6.0 * max(from_here.expected_px[n] for n in from_here.reference_rad)
    try:
        fit = fit_mast(
            views, mast_parameters, expected_px=expected, rough=rough, keep_all=mast_parameters == 4
        )
    except MastNotFitted as error:
        raise SurveyNotFitted(f"mast: {error}") from None
    return fit.mast, {**doubtful, **dict.fromkeys(fit.left_out, float(np.sqrt(2) * fit.limit_px))}


def _carry(
    from_here: Start, camera_images: list[ImageTerm], mast: FloatArray
) -> dict[str, FloatArray] | None:
    """Dots of camera images as they would lie were the head at the reference; None if it was."""
    points, moved = {}, False
    for term in camera_images:
        places = from_here.estimate.rover_from_board[term.board].points(term.in_board_m)
        if term.camera in from_here.reference_rad:
            reference = from_here.reference_rad[term.camera]
            now, then = gimbal(mast, term.pan_rad, term.tilt_rad), gimbal(mast, *reference)
            moved |= (
                max(abs(term.pan_rad - reference[0]), abs(term.tilt_rad - reference[1])) > SAME_SETTING_RAD
            )
            places = ((places - now.translation_m) @ now.rotation) @ then.rotation.T + then.translation_m
        points[term.name] = places
    return points if moved else None


def _cameras_again(
    survey: Survey, from_here: Start, camera_images: list[ImageTerm], mast: FloatArray, doubtful: set[str]
) -> dict[str, CameraModel]:
    """Cameras fitted once more, small differences of the joint angles taken out by the mast."""
    points = _carry(from_here, camera_images, mast)
    found: dict[str, CameraModel] = {}
    if points is None:
        return found
    for name in from_here.reference_rad:
        group = [t for t in camera_images if t.camera == name and t.name not in doubtful]
        found[name] = camera_from_points(survey, name, group, points, from_here.expected_px[name]).model
    return found


def _to_head(
    cameras: Mapping[str, CameraModel], from_here: Start, mast: FloatArray
) -> dict[str, CameraModel]:
    """Head cameras carried from the rover frame, at their reference, to the head."""
    carrying = mast_of(mast)
    found = {}
    for name, model in cameras.items():
        at = from_here.reference_rad.get(name)
        found[name] = model if at is None else model.moved(carrying.rover_from_head(*at).inverse)
    return found


def _bent_notes(from_here: Start) -> list[str]:
    """Why the images of a board whose tapes cannot be right were left out."""
    return [
        f"the tapes of placement {placement} (set-up {setup}) do not have the board's shape and three cannot "
        "show which is wrong: its images were not used"
        for setup, placement in sorted(from_here.bent)
    ]


def _left_out(images: Sequence[ImageResiduals], doubtful: Mapping[str, float]) -> list[Outlier]:
    """The images left out, with how far they are off and the limit that they failed, nan if by no test.

    ``doubtful`` holds the rms distance of an image's dots, px, that would have been allowed.
    """
    found = []
    for image in images:
        if image.name not in doubtful:
            continue
        in_sigmas = image.residuals_px / image.sigma_px[:, None]
        size = float(np.sqrt(np.mean(np.sum(image.residuals_px**2, axis=1))))
        limit = float(np.sum((doubtful[image.name] / image.sigma_px) ** 2))
        found.append(Outlier("image", f"image {image.name}", float(np.sum(in_sigmas**2)), limit, size))
    return found
