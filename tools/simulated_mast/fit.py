"""Fit a rig to a survey: cameras, mast, boards and set-ups together, each measurement weighted by its sigma.

Start values are the drawing's. R0 is fixed at 0 (A, H and V absorb it); skew, lens axis, lens terms and
entrance pupil carry wide priors, since a small board sees little of them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from calib.cahvor import CameraModel
from calib.mast import Mast, Rig, RigCamera
from calib.rigid import Rigid

from .survey import DOTS_IN_BOARD_M, PRISMS_IN_ROVER_M, TAPES_IN_BOARD_M, Image, Sigmas, Survey

MAST_DRAWING = np.array([0.345, 0.0, -1.455, 0.0, 0.0, 0.0, 0.0, 0.0])
STEPS = 40
SETTLED = 1e-9
"""The fit ends when a step lowers the cost by less than this part of it."""


@dataclass(frozen=True)
class Drawing:
    """What the drawing says about a camera: where, which way down it looks (rad), focal length."""

    on: str
    size_px: tuple[int, int]
    kind: str
    place_m: tuple[float, float, float]
    down_rad: float
    focal_px: float


def _pair(name: str, half_m: float, **rest: object) -> dict[str, Drawing]:
    x, z = rest.pop("x"), rest.pop("z")
    return {
        f"{name}_{side}": Drawing(place_m=(x, sign * half_m, z), **rest)  # type: ignore[arg-type]
        for side, sign in (("left", -1), ("right", 1))
    }


_HEAD = {"on": "head", "size_px": (1024, 768), "kind": "CAHVOR", "down_rad": 0.0}
DRAWINGS = {
    **_pair("pancam", 0.15, x=0.06, z=-0.055, focal_px=16 / 0.00465, **_HEAD),
    **_pair("navcam", 0.10, x=0.06, z=0.03, focal_px=6 / 0.00465, **_HEAD),
    **_pair(
        "hazcam",
        0.05,
        x=0.40,
        z=-0.50,
        focal_px=2.3 / 0.00744,
        on="rover",
        size_px=(640, 480),
        kind="CAHVORE",
        down_rad=np.radians(38),
    ),
}

# C (3), turn (3), fx, fy, cx, cy, skew, lens axis (2), r1, r2, e0, e1
PRIOR = np.array([np.inf] * 10 + [2e-3, 0.01, 0.01, 0.2, 0.1, 2e-3, 2e-3])
CAMERA_STEP = np.array([1e-6] * 3 + [1e-7] * 3 + [1e-3] * 4 + [1e-7] * 3 + [1e-6] * 4)


def _start(drawing: Drawing) -> np.ndarray:
    w, h = drawing.size_px
    middle = [(w - 1) / 2, (h - 1) / 2]
    f = drawing.focal_px
    return np.array([*drawing.place_m, 0, 0, 0, f, f, *middle, 0, 0, 0, 0, 0, 0.004, 0.001])


def _model(drawing: Drawing, p: np.ndarray) -> CameraModel:
    """The camera of a parameter vector."""
    turned = Rotation.from_euler("y", -drawing.down_rad) * Rotation.from_rotvec(p[3:6])
    a, h, v = turned.as_matrix().T
    v = v + p[10] * h
    v = v / np.linalg.norm(v)
    o = a + p[11] * h + p[12] * v
    vectors = {"C": p[:3], "A": a, "H": p[6] * h + p[8] * a, "V": p[7] * v + p[9] * a}
    lens = {"O": o / np.linalg.norm(o), "R": np.array([0.0, p[13], p[14]])}
    if drawing.kind == "CAHVORE":
        lens |= {"E": np.array([p[15], p[16], 0.0])}
        return CameraModel("CAHVORE", drawing.size_px, **vectors, **lens, cahvore_type=2, linearity=0.0)
    return CameraModel("CAHVOR", drawing.size_px, **vectors, **lens)


def _mast(p: np.ndarray) -> Mast:
    return Mast(p[:3], p[3:6], float(p[6]), float(p[7]))


def _rigid(p: np.ndarray) -> Rigid:
    return Rigid(Rotation.from_rotvec(p[3:]).as_matrix(), p[:3])


def _aligned(to_m: np.ndarray, from_m: np.ndarray) -> np.ndarray:
    """Six numbers of the rigid transform that carries points best onto their measurements."""
    to_mid, from_mid = to_m.mean(0), from_m.mean(0)
    rotation, _ = Rotation.align_vectors(to_m - to_mid, from_m - from_mid)
    return np.concatenate([to_mid - rotation.apply(from_mid), rotation.as_rotvec()])


class _Problem:
    """The parameter vector's places and the weighted residuals with their Jacobian."""

    def __init__(self, survey: Survey, sigmas: Sigmas, mast_parameters: int) -> None:
        self.survey, self.sigmas = survey, sigmas
        self.mast_parameters = mast_parameters
        self.names = [n for n in DRAWINGS if any(i.camera == n for i in survey.images)]
        start: list[np.ndarray] = []
        self.at: dict[object, slice] = {}

        def add(key: object, values: np.ndarray) -> None:
            first = sum(v.size for v in start)
            self.at[key] = slice(first, first + values.size)
            start.append(values)

        for name in self.names:
            add(name, _start(DRAWINGS[name])[: 17 if DRAWINGS[name].kind == "CAHVORE" else 15])
        add("mast", MAST_DRAWING[:mast_parameters])
        for setup, prisms in survey.prisms_m.items():
            add(setup, _aligned(prisms, PRISMS_IN_ROVER_M))
        for key, tapes in survey.tapes_m.items():
            rover_from_station = _rigid(start[[*self.at].index(key[0])]).inverse
            add(key, _aligned(rover_from_station.points(tapes), TAPES_IN_BOARD_M))
        self.start = np.concatenate(start)

    def part(self, x: np.ndarray, key: object) -> np.ndarray:
        """The numbers of one thing."""
        p = x[self.at[key]]
        if key in DRAWINGS:
            return np.concatenate([p, np.zeros(17 - p.size)])
        return np.concatenate([p, np.zeros(8 - p.size)]) if key == "mast" else p

    def normal(self, x: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        """Cost, J^T J and J^T r of all measurements and priors."""
        cost, jtj, jtr = 0.0, np.zeros((x.size, x.size)), np.zeros(x.size)
        for residual, blocks in self._terms(x):
            cost += float(residual @ residual)
            if not np.isfinite(cost):
                return np.inf, jtj, jtr
            columns = np.concatenate([np.arange(self.at[k].start, self.at[k].start + b.shape[1]) for k, b in blocks])
            jacobian = np.concatenate([b for _, b in blocks], axis=1)
            jtj[np.ix_(columns, columns)] += jacobian.T @ jacobian
            jtr[columns] += jacobian.T @ residual
        return cost, jtj, jtr

    def cost(self, x: np.ndarray) -> float:
        """Sum of squares of the weighted residuals."""
        return sum(float(r @ r) for r, _ in self._terms(x, jacobian=False))

    def _terms(self, x: np.ndarray, jacobian: bool = True):  # type: ignore[no-untyped-def]
        """Residual and Jacobian blocks of every measurement group."""
        for image in self.survey.images:
            yield self._image(x, image, jacobian)
        for setup, prisms in self.survey.prisms_m.items():
            yield self._points(x, [setup], lambda p: _rigid(p[0]).points(PRISMS_IN_ROVER_M), prisms, jacobian)
        for key, tapes in self.survey.tapes_m.items():

            def corners(p: list[np.ndarray]) -> np.ndarray:
                return _rigid(p[0]).points(_rigid(p[1]).points(TAPES_IN_BOARD_M))

            yield self._points(x, [key[0], key], corners, tapes, jacobian)
        for name in self.names:
            p = x[self.at[name]]
            sigma = PRIOR[: p.size]
            yield (p - _start(DRAWINGS[name])[: p.size]) / sigma, [(name, np.diag(1 / sigma))]

    def _points(
        self,
        x: np.ndarray,
        keys: list[object],
        predict: Callable[[list[np.ndarray]], np.ndarray],
        measured: np.ndarray,
        jacobian: bool,
    ) -> tuple[np.ndarray, list[tuple[object, np.ndarray]]]:
        """A group of station measurements."""
        parts = [self.part(x, key) for key in keys]
        sigma = self.sigmas.station_m
        base = predict(parts)
        blocks = []
        for index, key in enumerate(keys if jacobian else []):
            def moved(p: np.ndarray, index: int = index) -> np.ndarray:
                return predict([*parts[:index], p, *parts[index + 1 :]])

            blocks.append((key, _differences(moved, base, parts[index], np.full(6, 1e-6), 6) / sigma))
        return ((base - measured) / sigma).ravel(), blocks

    def _image(
        self, x: np.ndarray, image: Image, jacobian: bool
    ) -> tuple[np.ndarray, list[tuple[object, np.ndarray]]]:
        """One picture's dots."""
        drawing = DRAWINGS[image.camera]
        board_key = (image.setup, image.placement)
        dots = DOTS_IN_BOARD_M[image.dots]

        def in_frame(mast: np.ndarray, board: np.ndarray) -> np.ndarray:
            points = _rigid(board).points(dots)
            if drawing.on == "head":
                points = _mast(mast).rover_from_head(image.pan_rad, image.tilt_rad).inverse.points(points)
            return points

        camera, mast, board = (self.part(x, key) for key in (image.camera, "mast", board_key))
        model = _model(drawing, camera)
        points = in_frame(mast, board)
        base, _ = model.project(points)
        sigma = self.sigmas.dot_px
        residual = ((base - image.pixels_px) / sigma).ravel()
        if not jacobian:
            return residual, []
        size = self.at[image.camera].stop - self.at[image.camera].start
        by_camera = _differences(
            lambda p: _model(drawing, p).project(points)[0], base, camera, CAMERA_STEP, size
        )
        by_board = _differences(lambda p: model.project(in_frame(mast, p))[0], base, board, np.full(6, 1e-6), 6)
        blocks: list[tuple[object, np.ndarray]] = [(image.camera, by_camera / sigma), (board_key, by_board / sigma)]
        if drawing.on == "head":
            by_mast = _differences(
                lambda p: model.project(in_frame(p, board))[0], base, mast, np.full(8, 1e-6), self.mast_parameters
            )
            blocks.append(("mast", by_mast / sigma))
        return residual, blocks


def _differences(
    predict: Callable[[np.ndarray], np.ndarray], base: np.ndarray, p: np.ndarray, steps: np.ndarray, size: int
) -> np.ndarray:
    """Jacobian (base.size, size) by forward differences."""
    columns = []
    for index in range(size):
        moved = p.copy()
        moved[index] += steps[index]
        columns.append((predict(moved) - base).ravel() / steps[index])
    return np.stack(columns, axis=1)


@dataclass(frozen=True)
class Fitted:
    """The rig, the rms residual of each camera (x, y; pixels), and the root of cost over degrees of freedom."""

    rig: Rig
    rms_px: dict[str, tuple[float, float]]
    unit_weight: float


def fit(survey: Survey, name: str, stereo: dict[str, tuple[str, str]], sigmas: Sigmas, mast_parameters: int) -> Fitted:
    """Return the rig that fits a survey best.

    Levenberg-Marquardt on the normal equations, columns scaled to one.

    Raises
    ------
    RuntimeError
        If it does not settle, or settles far above the noise.
    """
    problem = _Problem(survey, sigmas, mast_parameters)
    x, damping = problem.start, 1e-3
    cost, jtj, jtr = problem.normal(x)
    for _ in range(STEPS):
        scale = 1 / np.sqrt(np.maximum(np.diag(jtj), 1e-12))
        scaled = jtj * np.outer(scale, scale)
        step = -scale * np.linalg.solve(scaled + damping * np.eye(x.size), scale * jtr)
        new_cost = problem.cost(x + step)
        if not new_cost < cost:
            damping *= 10
            if damping > 1e6:
                break
            continue
        gained = cost - new_cost
        x, damping = x + step, max(damping / 10, 1e-12)
        cost, jtj, jtr = problem.normal(x)
        if gained < SETTLED * cost:
            break
    else:
        raise RuntimeError(f"the fit did not settle in {STEPS} steps")
    rms_px = {}
    for camera in problem.names:
        residuals = [
            problem._image(x, image, jacobian=False)[0].reshape(-1, 2) * sigmas.dot_px
            for image in survey.images
            if image.camera == camera
        ]
        rms = np.sqrt((np.concatenate(residuals) ** 2).mean(0))
        rms_px[camera] = (float(rms[0]), float(rms[1]))
    measurements = sum(2 * len(i.dots) for i in survey.images)
    measurements += 3 * sum(len(p) for p in (*survey.prisms_m.values(), *survey.tapes_m.values()))
    unit_weight = float(np.sqrt(cost / (measurements - x.size)))
    if unit_weight > 1.5:
        raise RuntimeError(f"the fit ended in a wrong minimum: {unit_weight:.2f} times the noise")
    cameras = {
        n: RigCamera(DRAWINGS[n].on, _model(DRAWINGS[n], problem.part(x, n)))  # type: ignore[arg-type]
        for n in problem.names
    }
    return Fitted(Rig(name, _mast(problem.part(x, "mast")), cameras, stereo), rms_px, unit_weight)
