"""Pictures of boards for campaigns, drawn by OpenCV, with where each corner truly is.

The print is a bitmap, laid through OpenCV's camera model onto a grid four times as fine as the pixels,
blurred there and summed up over each pixel: nothing of the detector, nor of the simulator, has a part in
it. The bitmap's edges lie between its texels, and it is a little smooth, so bilinear interpolation keeps
them where they are.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calib.targets.boards import AnyBoard, AprilGrid, Charuco, DotBoard
from calib.targets.pattern import pattern_of

FloatArray = NDArray[np.float64]
Float32 = NDArray[np.float32]
Levels = NDArray[np.uint8] | NDArray[np.uint16]

FINER = 4
SIZE_PX, FOCAL_PX = (1024, 768), 1290.0
MIDDLE = (np.array(SIZE_PX) - 1) / 2
MATRIX = np.array([[FOCAL_PX, 0, MIDDLE[0]], [0, FOCAL_PX, MIDDLE[1]], [0, 0, 1]])
LENS = np.array([-0.12, 0.05, 0.001, -0.0008, 0.0])
"""OpenCV's k1, k2, p1, p2, k3: 13 px at the picture's corners."""

PAPER_DN, INK_DN = 205.0, 35.0
MARGIN = 0.5
"""White paper around the print, of a cell of the print."""

TEXELS, SMOOTH = 1.5, 0.8
"""Texels of the print in a cell of the fine grid where it is nearest; and over how many cells the print is
smooth, or these would see its edges in steps."""

LINES = 6
"""Texels of a gap are a multiple of this: cells of 6 mm and gaps of 18 mm, as here, are whole numbers of
them."""

PAD_PX = 16
"""Drawn around the picture, for what blurs across its rim."""

STEP_PX = 2
"""Between pixels whose rays are sought; between them the map is straight to a thousandth of a pixel."""


@dataclass(frozen=True, eq=False)
class Placed:
    """A board before the camera: rotation vector and place of its frame, OpenCV's rvec and tvec."""

    board: AnyBoard
    turn: FloatArray
    place_m: FloatArray

    @property
    def truth_px(self) -> FloatArray:
        """Where its corners are, (n, 2), by cv2.projectPoints."""
        points = self.board.in_board_m(self.board.ids)
        pixels, _ = cv2.projectPoints(points, self.turn, self.place_m, MATRIX, LENS)
        return np.asarray(pixels, dtype=np.float64).reshape(-1, 2)


def placed(
    rng: np.random.Generator,
    board: AnyBoard,
    slant_deg: tuple[float, float],
    range_m: tuple[float, float],
    aside: float = 0.5,
    roll_deg: float = 180.0,
) -> Placed:
    """Return a board slanted about a random axis, rolled, its middle up to ``aside`` from the image's."""
    about, slant = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(*slant_deg))
    tilt = Rotation.from_rotvec(slant * np.array([np.cos(about), np.sin(about), 0.0]))
    roll = Rotation.from_rotvec([0, 0, np.radians(rng.uniform(-roll_deg, roll_deg))])
    x, y = MIDDLE * aside * rng.uniform(-1, 1, 2) / FOCAL_PX
    place = rng.uniform(*range_m) * np.array([x, y, 1.0])
    return Placed(board, (tilt * roll).as_rotvec(), place)


def light(boards: Sequence[Placed], background: Float32 | None = None) -> Float32:
    """Return what falls on the fine grid, grey levels of 0 to 255, later boards over earlier ones."""
    width, height = ((size + 2 * PAD_PX) * FINER for size in SIZE_PX)
    if background is None:
        x, y = np.meshgrid(np.arange(width) / FINER, np.arange(height) / FINER)
        background = (110.0 + 40.0 * np.sin(x / 61.0) * np.cos(y / 47.0)).astype(np.float32)
    image = background
    rays = _rays()
    for one in boards:
        texture, texel_m, middle = _print(one)
        rotation, _ = cv2.Rodrigues(one.turn)
        # a ray r meets the board where R^T (s r - t) has no z
        down = rays @ rotation
        origin = -(one.place_m @ rotation)
        with np.errstate(divide="ignore", invalid="ignore"):
            along = -origin[2] / down[..., 2]
            along[along <= 0] = np.nan
        hits = origin[:2] + along[..., None] * down[..., :2]
        coarse = (hits / texel_m + middle).astype(np.float32)
        u, v = (
            cv2.warpAffine(
                np.nan_to_num(coarse[..., k], nan=-1e6), _ENLARGE, (width, height),
                flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, borderMode=cv2.BORDER_REPLICATE,
            )
            for k in (0, 1)
        )  # fmt: skip
        both = cv2.remap(texture, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
        cover = cv2.remap(
            np.full(texture.shape, 255, np.uint8), u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT
        )
        ink = both.astype(np.float32) / 255.0
        part = cover.astype(np.float32) / 255.0
        image = image * (1.0 - part) + INK_DN * part + (PAPER_DN - INK_DN) * ink
    return np.asarray(image, dtype=np.float32)


def photographed(
    rng: np.random.Generator,
    fine: Float32,
    blur_px: float,
    noise_dn: float,
    *,
    smear_px: float = 0.0,
    contrast: float = 1.0,
    gradient: float = 0.0,
    bits: int = 8,
) -> Levels:
    """Return the picture that a camera delivers; 16 bits hold 200 steps a level."""
    if blur_px:
        fine = cv2.GaussianBlur(fine, (0, 0), blur_px * FINER).astype(np.float32)
    if smear_px:
        wide = round(smear_px * FINER) | 1
        fine = cv2.blur(fine, (wide, 1)).astype(np.float32)
    rim = PAD_PX * FINER
    seen = cv2.resize(fine[rim:-rim, rim:-rim], SIZE_PX, interpolation=cv2.INTER_AREA)
    if gradient:
        seen = seen * np.linspace(1.0, 1.0 - gradient, SIZE_PX[0], dtype=np.float32)
    noisy = seen * contrast + noise_dn * rng.standard_normal(seen.shape)
    if bits == 8:
        return np.asarray(np.clip(np.rint(noisy), 0, 255), dtype=np.uint8)
    return np.asarray(np.clip(np.rint(noisy * 200.0), 0, 65535), dtype=np.uint16)


_ENLARGE = np.array(
    [
        [1 / (FINER * STEP_PX), 0, (0.5 / FINER - 0.5) / STEP_PX],
        [0, 1 / (FINER * STEP_PX), (0.5 / FINER - 0.5) / STEP_PX],
    ]
)
"""From a cell of the fine grid to the grid of rays; a pixel's middle is between its second and third cell."""


def _rays() -> FloatArray:
    """Directions (h, w, 3) of every second pixel's ray, z = 1."""
    x, y = np.meshgrid(
        *(np.arange(-PAD_PX, size + PAD_PX + STEP_PX, STEP_PX, dtype=np.float64) for size in SIZE_PX)
    )
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 60, 1e-12)
    pixels = np.stack([x, y], axis=-1).reshape(-1, 1, 2)
    flat = cv2.undistortPointsIter(pixels, MATRIX, LENS, None, None, stop).reshape(*x.shape, 2)
    return np.dstack([flat, np.ones_like(x)])


def _print(one: Placed) -> tuple[NDArray[np.uint8], float, FloatArray]:
    """The print as a bitmap, a texel's side in metres, and the texel (u, v) of the board's origin."""
    board = one.board
    cell_m = float(min(np.diff(line).min() for line in board.lines_m))
    points = one.board.in_board_m(one.board.ids)
    rotation, _ = cv2.Rodrigues(one.turn)
    depth = (points @ rotation.T + one.place_m)[:, 2]
    # the most that a metre of the board can measure in the fine grid, slant or not
    most = FOCAL_PX * FINER / max(float(depth.min()), 0.1)
    count = int(np.clip(np.floor(cell_m * most * TEXELS), 12, 448))
    smooth = SMOOTH * count / (cell_m * most)
    if isinstance(board, Charuco):
        return _opencvs(board, 56 * max(1, round(count / 56)), smooth)
    if isinstance(board, AprilGrid):
        # its lines are to lie between texels: gap, and a tag of so many cells
        count = max(1, round(count / LINES)) * LINES
    texel_m = cell_m / count
    half = [int(np.ceil((size / 2 + MARGIN * cell_m) / texel_m)) for size in board.size_m]
    if not isinstance(board, DotBoard):
        # a line between texels: with an odd number of half cells the origin is in the middle of a texel
        shift = [(line[0] / texel_m) % 1.0 for line in board.lines_m]
    else:
        shift = [0.0, 0.0]
    fine = 4 if isinstance(board, DotBoard) else 1
    sub = (np.arange(fine) + 0.5) / fine
    axes = [
        ((np.arange(-n, n)[:, None] + s + sub) * texel_m).ravel() for n, s in zip(half, shift, strict=True)
    ]
    pattern = pattern_of(board)
    white = np.empty((2 * half[1], 2 * half[0]), dtype=np.uint8)
    for first in range(0, 2 * half[1], 64):
        rows = axes[1][fine * first : fine * (first + 64)]
        black = pattern.is_black(*np.meshgrid(axes[0], rows)).reshape(-1, fine, 2 * half[0], fine)
        white[first : first + 64] = np.rint(255.0 * (1.0 - black.mean(axis=(1, 3))))
    middle = np.array([n - s - 0.5 for n, s in zip(half, shift, strict=True)])
    return _smoothed(white, smooth), texel_m, middle


def _smoothed(bitmap: NDArray[np.uint8], texels: float) -> NDArray[np.uint8]:
    return np.asarray(cv2.GaussianBlur(bitmap, (0, 0), texels), dtype=np.uint8)


def _opencvs(board: Charuco, texels: int, smooth: float) -> tuple[NDArray[np.uint8], float, FloatArray]:
    """OpenCV's own drawing of its board."""
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
    ids = np.arange(board.columns * board.rows // 2) + board.first_id
    size = board.columns, board.rows
    theirs = cv2.aruco.CharucoBoard(size, board.square_m, board.marker_m, dictionary, ids)
    theirs.setLegacyPattern(board.legacy)
    drawing = theirs.generateImage((size[0] * texels, size[1] * texels), marginSize=0, borderBits=1)
    rim = int(np.ceil(MARGIN * texels))
    paper = cv2.copyMakeBorder(drawing, rim, rim, rim, rim, cv2.BORDER_CONSTANT, value=255)
    return (
        _smoothed(paper, smooth),
        board.square_m / texels,
        np.array([n * texels / 2 + rim - 0.5 for n in size]),
    )


class Pictured(Protocol):
    """A result that has pictures (PNG) by their names."""

    @property
    def pictures(self) -> Mapping[str, bytes]: ...


def keep_pictures(folder: Path | None, found: Iterable[Pictured]) -> None:
    """Write the pictures of results into a folder (made if need be); nothing without one."""
    if folder is None:
        return
    folder.mkdir(parents=True, exist_ok=True)
    for one in found:
        for name, png in one.pictures.items():
            (folder / name).write_bytes(png)
