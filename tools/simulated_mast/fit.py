"""Fit a rig to a survey in the paper's two steps (section III, B and C).

First every camera on its own, from boards seen at one joint setting; then the mast, with the cameras held as
they were at that setting. The surveyed points are taken as exact, so what the station left in them ends up in
cameras and mast. Start values are the drawing's. R0 is fixed at 0 (A, H and V absorb it); skew, lens axis,
lens terms and entrance pupil carry wide priors, since a small board sees little of them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from calib.cahvor import CameraModel
from calib.mast import Mast, Rig, RigCamera
from calib.rigid import Rigid

from .survey import DOTS_IN_BOARD_M, PRISMS_IN_ROVER_M, TAPES_IN_BOARD_M, Image, Sigmas, Survey

MAST_DRAWING = np.array([0.345, 0.0, -1.455, 0.0, 0.0, 0.0, 0.0, 0.0])
ENOUGH_IMAGES = 7  # the paper takes seven or eight
WRONG_MINIMUM_PX = 2.0
"""A camera's residual above this is no noise: 1 mm at 5 m is 0.7 px of the Pancam, a dot 0.1 px."""


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
    """The mast of six or eight numbers."""
    return Mast(p[:3], p[3:6], *(float(v) for v in p[6:]))


@dataclass(frozen=True)
class Fitted:
    """The rig, and the rms residual of each camera (x, y; pixels) over the images it was fitted to."""

    rig: Rig
    camera_rms_px: dict[str, tuple[float, float]]
    mast_rms_px: dict[str, tuple[float, float]]


def fit(
    survey: Survey, name: str, stereo: dict[str, tuple[str, str]], sigmas: Sigmas, mast_parameters: int
) -> Fitted:
    """Return the rig that the survey gives, with a mast of six or eight parameters.

    Raises
    ------
    RuntimeError
        If a camera sees too few whole boards, or it or the mast ends far above the noise.
    """
    dots_in_rover = _surveyed_dots(survey)
    in_rover: dict[str, tuple[CameraModel, float, float]] = {}
    camera_rms_px = {}
    for camera, drawing in DRAWINGS.items():
        images = [i for i in survey.images if i.camera == camera and i.purpose == "camera"]
        if len(images) < ENOUGH_IMAGES:
            raise RuntimeError(f"{camera} sees only {len(images)} whole boards, {ENOUGH_IMAGES} are needed")
        model, camera_rms_px[camera] = _fit_camera(drawing, images, dots_in_rover, sigmas)
        in_rover[camera] = (model, images[0].pan_rad, images[0].tilt_rad)
    images = [i for i in survey.images if i.purpose == "mast"]

    def in_head(camera: str, mast: Mast) -> CameraModel:
        model, pan_rad, tilt_rad = in_rover[camera]
        return model.moved(mast.rover_from_head(pan_rad, tilt_rad).inverse)

    def residuals(p: np.ndarray) -> np.ndarray:
        mast = _mast(p)
        heads = {camera: in_head(camera, mast) for camera in {i.camera for i in images}}
        rows = []
        for image in images:
            model = heads[image.camera].moved(mast.rover_from_head(image.pan_rad, image.tilt_rad))
            rows.append(_project(model, dots_in_rover[image.setup, image.placement]) - image.pixels_px)
        return np.concatenate(rows).ravel()

    found = least_squares(residuals, MAST_DRAWING[:mast_parameters], x_scale="jac")
    mast = _mast(found.x)
    misses = np.split(found.fun.reshape(-1, 2), np.cumsum([len(i.pixels_px) for i in images])[:-1])
    mast_rms_px = {
        camera: _rms([miss for miss, i in zip(misses, images, strict=True) if i.camera == camera])
        for camera in sorted({i.camera for i in images})
    }
    worst_px = max(max(rms) for rms in (*camera_rms_px.values(), *mast_rms_px.values()))
    if worst_px > WRONG_MINIMUM_PX:
        raise RuntimeError(f"the fit ended in a wrong minimum: a camera's residual is {worst_px:.2f} px rms")
    cameras = {
        camera: RigCamera("head", in_head(camera, mast))
        if drawing.on == "head"
        else RigCamera("rover", in_rover[camera][0])
        for camera, drawing in DRAWINGS.items()
    }
    return Fitted(Rig(name, mast, cameras, stereo), camera_rms_px, mast_rms_px)


def _surveyed_dots(survey: Survey) -> dict[tuple[str, str], np.ndarray]:
    """Where the dots of each board are in the rover frame, going by prisms and tapes."""
    dots = {}
    for (setup, placement), tapes in survey.tapes_m.items():
        rover_from_station = _aligned(survey.prisms_m[setup], PRISMS_IN_ROVER_M).inverse
        rover_from_board = _aligned(rover_from_station.points(tapes), TAPES_IN_BOARD_M)
        dots[setup, placement] = rover_from_board.points(DOTS_IN_BOARD_M)
    return dots


def _aligned(to_m: np.ndarray, from_m: np.ndarray) -> Rigid:
    """The rigid transform that carries points best onto their measurements."""
    to_mid, from_mid = to_m.mean(0), from_m.mean(0)
    rotation, _ = Rotation.align_vectors(to_m - to_mid, from_m - from_mid)
    return Rigid(rotation.as_matrix(), to_mid - rotation.apply(from_mid))


def _fit_camera(
    drawing: Drawing, images: list[Image], dots_in_rover: dict[tuple[str, str], np.ndarray], sigmas: Sigmas
) -> tuple[CameraModel, tuple[float, float]]:
    """One camera in the rover frame at the one joint setting of its images, and its rms residual."""
    start = _start(drawing)
    size = start.size if drawing.kind == "CAHVORE" else start.size - 2
    rover_from_frame = Rigid.identity()
    if drawing.on == "head":
        rover_from_frame = _mast(MAST_DRAWING).rover_from_head(images[0].pan_rad, images[0].tilt_rad)

    def model(p: np.ndarray) -> CameraModel:
        return _model(drawing, np.concatenate([p, start[size:]])).moved(rover_from_frame)

    def misses(p: np.ndarray) -> np.ndarray:
        camera = model(p)
        rows = [_project(camera, dots_in_rover[i.setup, i.placement]) - i.pixels_px for i in images]
        return np.concatenate(rows)

    def residuals(p: np.ndarray) -> np.ndarray:
        return np.concatenate([misses(p).ravel() / sigmas.dot_px, (p - start[:size]) / PRIOR[:size]])

    # First where it is and looks, with the drawing's lens; a fit of everything at once may run away.
    pose = least_squares(lambda p: residuals(np.concatenate([p, start[6:size]])), start[:6], x_scale="jac")
    found = least_squares(residuals, np.concatenate([pose.x, start[6:size]]), x_scale="jac")
    return model(found.x), _rms([misses(found.x)])


def _project(model: CameraModel, points_m: np.ndarray) -> np.ndarray:
    """Pixels, a thousand pixels off where the model cannot project, so that a fit turns back."""
    return np.nan_to_num(model.project(points_m)[0], nan=-1000.0)


def _rms(misses_px: list[np.ndarray]) -> tuple[float, float]:
    """Root mean square in x and y."""
    x, y = np.sqrt((np.concatenate(misses_px) ** 2).mean(0))
    return float(x), float(y)
