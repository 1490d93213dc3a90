"""Covariance of the paper's two steps: the station's noise moves boards and set-ups, the cameras follow, and
the mast follows both.

Written with normal equations (k cameras, m mast, s station: boards, set-ups, prisms and joints)

    dk = -Nkk⁻¹ (Nks ds + dots),    dm = -Nmm⁻¹ (Nms ds + Nmk dk + dots),

k from the camera images, m from the mast images, ds with the covariance that prisms and tapes give.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from calib.camera.cahvor import CameraModel
from calib.camera.parameters import parameter_names, parameter_part, predict, stepped
from calib.fit.adjustment import KNOWN_BEFOREHAND, MAST, Adjustment, Estimate
from calib.fit.least_squares import covariance_of
from calib.fit.terms import ImageTerm
from calib.fit.usual_lens import lens_knowledge
from calib.mast.gimbal import gimbal, gimbal_rates
from calib.rigid import FloatArray, rigid_rates, tangents


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
        size, total = problem.parts[MAST].stop, len(problem.names)
        first, second = np.zeros((total, total)), np.zeros((total, total))
        for term in problem.images:
            if term.keep.any():
                block = self._block(term)
                at = np.ix_(block.columns, block.columns)
                (first if term.name in camera_images else second)[at] += block.jacobian.T @ block.jacobian
        k, m = np.arange(problem.parts[MAST].start), np.arange(problem.parts[MAST].start, size)
        s = np.arange(size, total)
        camera_matrix = first[np.ix_(k, k)] + np.diag(problem.weak[k])
        for name, model in self.cameras.items():
            if "O" in model.kind:
                _, rows = lens_knowledge(model)
                part = problem.parts["camera", name]
                camera_matrix[part, part] += rows.T @ rows
        by_dots_k = covariance_of(camera_matrix)
        k_by_s = -by_dots_k @ first[np.ix_(k, s)]
        by_dots_m = covariance_of(second[np.ix_(m, m)], problem.weak[m]) if len(m) else np.zeros((0, 0))
        m_by_k = -by_dots_m @ second[np.ix_(m, k)]
        m_by_s = -by_dots_m @ second[np.ix_(m, s)] + m_by_k @ k_by_s
        follow = np.concatenate([np.eye(len(k)), m_by_k])
        dots = follow @ by_dots_k @ follow.T
        dots[len(k) :, len(k) :] += by_dots_m
        by_s = np.concatenate([k_by_s, m_by_s])
        to_head = self._to_head(size)
        station = by_s @ self._station(s) @ by_s.T
        return to_head @ (dots + station) @ to_head.T, to_head @ dots @ to_head.T

    def _station(self, s: np.ndarray) -> FloatArray:
        """Covariance of set-ups, boards, prisms and joints from the station and what is known beforehand."""
        problem = self.problem
        matrix = np.diag(problem.weak)
        for point in problem.station:
            if not point.keep:
                continue
            block = problem.station_block(self.state, point)
            matrix[np.ix_(block.columns, block.columns)] += block.jacobian.T @ block.jacobian
        for name, block in problem.known(self.state):
            if not name.startswith(KNOWN_BEFOREHAND):
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

    def _to_head(self, size: int) -> FloatArray:
        """(size, size): from steps of cameras in the rover frame and of the mast to those of head cameras."""
        matrix = np.eye(size)
        for name, at in self.reference_rad.items():
            part = self.problem.parts["camera", name]
            columns = np.concatenate([self.problem.at(("camera", name)), self.problem.at(MAST)])
            count = part.stop - part.start
            nominal, in_rover = self.state.cameras[name], self.cameras[name]
            scale = np.full(len(columns), 1e-6)
            for letter in "HV":
                scale[parameter_part(nominal.kind, letter)] = 1e-3
            for index, column in enumerate(columns):
                step = np.zeros(len(columns))
                step[index] = scale[index]
                ends = [self._in_head(in_rover, at, nominal, sign * step, count) for sign in (1.0, -1.0)]
                matrix[part, column] = (ends[0] - ends[1]) / (2 * scale[index])
        return matrix

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
            if letter in nominal.kind:
                out[parameter_part(nominal.kind, letter)] = tangents(getattr(nominal, letter)) @ parts[letter]
        if "R" in nominal.kind:
            out[parameter_part(nominal.kind, "R")] = (model.R - nominal.R)[1:]
        if "E" in nominal.kind:
            out[parameter_part(nominal.kind, "E")] = model.E - nominal.E
        return out
