"""The data of compare_calibration.py: a photographed chessboard and simulated surveys of one camera."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from calib.files.mast_file import load_rig
from calib.geometry.cahvor import CameraModel
from calib.geometry.projection import project_as_published
from calib.geometry.rigid import Rigid

REPOSITORY = Path(__file__).resolve().parents[2]
COLUMNS, ROWS, SQUARE_M = 9, 6, 0.025
NOISE_PX = 0.1
SETTLED = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 200, 1e-12)


@dataclass(frozen=True, eq=False)
class BoardViews:
    """Corners of a chessboard: (54, 3) on the board, metres, and (n, 54, 2) in n pictures, pixels."""

    name: str
    size_px: tuple[int, int]
    in_board_m: np.ndarray
    pixels_px: np.ndarray


@dataclass(frozen=True, eq=False)
class Points:
    """Fixed points (n, 3), pixels (n, 2), which picture each is of (n,), and what a fit is to predict."""

    name: str
    size_px: tuple[int, int]
    focal_px: float
    points_m: np.ndarray
    pixels_px: np.ndarray
    images: np.ndarray
    probe_m: np.ndarray
    truth_px: np.ndarray


def read_views(folder: Path, side: str) -> BoardViews:
    """Find the corners in every picture of one side.

    Raises
    ------
    FileNotFoundError
        If there are no pictures.
    """
    files = sorted(folder.glob(f"{side}*.jpg"))
    if not files:
        raise FileNotFoundError(
            f"{folder} has no {side}*.jpg; it should hold OpenCV's stereo sample pictures"
        )
    found, size = [], (0, 0)
    for file in files:
        grey = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
        seen, corners = cv2.findChessboardCorners(grey, (COLUMNS, ROWS))
        if not seen:
            continue
        fine = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 100, 1e-4)
        found.append(cv2.cornerSubPix(grey, corners, (11, 11), (-1, -1), fine)[:, 0].astype(np.float64))
        size = (grey.shape[1], grey.shape[0])
    x, y = np.meshgrid(np.arange(COLUMNS) * SQUARE_M, np.arange(ROWS) * SQUARE_M)
    board = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=-1)
    return BoardViews(side, size, board, np.array(found))


def opencv_views(views: BoardViews, flags: int) -> tuple[float, np.ndarray, np.ndarray, list[Rigid]]:
    """Return OpenCV's rms, matrix, distortion and board poses (camera from board)."""
    boards = [views.in_board_m.astype(np.float32)] * len(views.pixels_px)
    pixels = [p.astype(np.float32) for p in views.pixels_px]
    found, matrix, lens, turns, shifts = cv2.calibrateCamera(
        boards, pixels, views.size_px, None, None, flags=flags, criteria=SETTLED
    )
    poses = [Rigid(cv2.Rodrigues(r)[0], t.ravel()) for r, t in zip(turns, shifts, strict=True)]
    return found, matrix, lens, poses


def views_as_points(views: BoardViews) -> Points:
    """Return the corners as fixed points in OpenCV's camera frame; nothing is to be predicted."""
    _, matrix, _, poses = opencv_views(views, 0)
    points = np.concatenate([pose.points(views.in_board_m) for pose in poses])
    images = np.repeat(np.arange(len(poses)), len(views.in_board_m))
    name = f"{views.name}: corners as fixed points"
    return Points(name, views.size_px, float(matrix[0, 0]), points, views.pixels_px.reshape(-1, 2), images,
                  np.zeros((0, 3)), np.zeros((0, 2)))  # fmt: skip


def simulated_survey(seed: int) -> Points:
    """Return dots on eight boards before the simulator's true left Navcam, with noise."""
    true = upright(load_rig(REPOSITORY / "configs" / "sim" / "rocky8.yaml").rig.cameras["navcam_left"].model)
    rng = np.random.default_rng(seed)
    width, height = true.size_px
    x, y = np.meshgrid(np.arange(10) - 4.5, np.arange(10) - 4.5)
    board = 0.08 * np.stack([x.ravel(), y.ravel(), np.zeros(100)], axis=-1)
    points, images = [], []
    for range_m, side in ((3.0, 0.27), (6.0, 0.18)):
        for px, py in ((side, side), (1 - side, side), (side, 1 - side), (1 - side, 1 - side)):
            ray = true.ray([(px * width, py * height)])
            axes = np.column_stack([*np.linalg.svd(ray.directions)[2][1:], ray.directions[0]])
            axes[:, 0] *= np.linalg.det(axes)
            turn = axes @ Rotation.from_rotvec(rng.uniform(-0.5, 0.5, 3)).as_matrix()
            images.append(np.full(100, len(images)))
            points.append(board @ turn.T + ray.origins_m + range_m * ray.directions)
    where = np.concatenate(points)
    grid = np.stack(np.meshgrid(np.linspace(0, width - 1, 9), np.linspace(0, height - 1, 7)), axis=-1)
    rays = true.ray(grid.reshape(-1, 2))
    probe = np.concatenate([rays.origins_m + r * rays.directions for r in (3.0, 6.0, 10.0)])
    seen = _as_published(true, where)
    focal = true.focal_px[0]
    return Points("simulated survey of a Navcam", true.size_px, focal, where,
                  seen + NOISE_PX * rng.standard_normal(seen.shape), np.concatenate(images), probe,
                  _as_published(true, probe))  # fmt: skip


def upright(model: CameraModel) -> CameraModel:
    """Return the camera with rows and columns at right angles: mrcal has no others."""
    across = model.H - (model.H @ model.A) * model.A
    down = model.V - (model.V @ model.A) * model.A
    return replace(model, V=model.V - (down @ across) / (across @ across) * across)


def _as_published(model: CameraModel, points_m: np.ndarray) -> np.ndarray:
    return project_as_published(
        points_m, model.C, model.A, model.H, model.V, model.O, model.R, np.zeros(3), None
    )
