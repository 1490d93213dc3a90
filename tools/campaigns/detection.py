"""Draw boards at random poses, find their corners or dots, and print how well, by board and by defect.

OpenCV projects the corners, with a lens that bends, at random slants, rolls and places. The print is a
bitmap, laid through OpenCV's camera model onto a grid four times as fine as the pixels, blurred there and
summed up over each pixel: nothing of the detector, nor of the simulator, has a part in it. The bitmap's
edges lie between its texels, and it is a little smooth, so bilinear interpolation keeps them where they
are. Each scene's images show the same boards, with each defect of the scene. Beside the corners found here
stand those of OpenCV's CharucoDetector on the same images.

    .venv/bin/python -m tools.campaigns.detection --cases 20 --seed 1
    .venv/bin/python -m tools.campaigns.detection --cases 3 --kind aprilgrid
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calib.targets.boards import AnyBoard, AprilGrid, Charuco, Checkerboard, CornersNotFound, DotBoard
from calib.targets.corners import find_corners
from calib.targets.pattern import pattern_of
from tools.command import end, options, results_of, rms, show

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


def light(one: Placed) -> Float32:
    """Return what falls on the fine grid, grey levels of 0 to 255."""
    width, height = ((size + 2 * PAD_PX) * FINER for size in SIZE_PX)
    x, y = np.meshgrid(np.arange(width) / FINER, np.arange(height) / FINER)
    image = (110.0 + 40.0 * np.sin(x / 61.0) * np.cos(y / 47.0)).astype(np.float32)
    rays = _rays()
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


def photographed(rng: np.random.Generator, fine: Float32, case: PictureCase) -> Levels:
    """Return the picture that a camera delivers; 16 bits hold 200 steps a level."""
    if case.blur_px:
        fine = cv2.GaussianBlur(fine, (0, 0), case.blur_px * FINER).astype(np.float32)
    if case.smear_px:
        wide = round(case.smear_px * FINER) | 1
        fine = cv2.blur(fine, (wide, 1)).astype(np.float32)
    rim = PAD_PX * FINER
    seen = cv2.resize(fine[rim:-rim, rim:-rim], SIZE_PX, interpolation=cv2.INTER_AREA)
    if case.gradient:
        seen = seen * np.linspace(1.0, 1.0 - case.gradient, SIZE_PX[0], dtype=np.float32)
    noisy = seen * case.contrast + case.noise_dn * rng.standard_normal(seen.shape)
    if case.bits == 8:
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


Image = NDArray[np.uint8]

BOARDS: dict[str, AnyBoard] = {
    "charuco": Charuco(12, 9, 0.04, 0.03, "DICT_5X5_100"),
    "aprilgrid": AprilGrid(6, 5, 0.06, 0.018),
    "checkerboard": Checkerboard(12, 9, 0.04),
    "dots": DotBoard(14, 10, 0.035, 0.0175),
}
WHOLE_M = (1.15, 1.5)
"""Boards without markers are put so far away that all of them is in the picture."""

OUTLIER_PX = 1.0
"""A corner so far from its truth is another corner: a wrong id."""


@dataclass(frozen=True)
class PictureCase:
    """What a picture suffers; blur and noise are standard deviations, ``hidden`` a part of the corners."""

    name: str
    blur_px: float = 0.7
    noise_dn: float = 2.0
    smear_px: float = 0.0
    hidden: float = 0.0
    contrast: float = 1.0
    gradient: float = 0.0
    bits: int = 8


@dataclass(frozen=True)
class BoardScene:
    """Where boards are, and what their pictures suffer."""

    name: str
    slant_deg: tuple[float, float]
    range_m: tuple[float, float]
    cases: tuple[PictureCase, ...]


SHARP = PictureCase("blur 0.7, noise 2")
SCENES = (
    BoardScene(
        "slant 0 to 40, 0.7 to 1.3 m",
        (0.0, 40.0),
        (0.7, 1.3),
        (
            SHARP,
            PictureCase("no blur", blur_px=0.0, noise_dn=1.0),
            PictureCase("blur 0.5", blur_px=0.5, noise_dn=1.0),
            PictureCase("blur 1.5", blur_px=1.5),
            PictureCase("blur 2.5", blur_px=2.5),
            PictureCase("smear 6 px", smear_px=6.0),
            PictureCase("noise 5", noise_dn=5.0),
            PictureCase("dark", contrast=0.12),
            PictureCase("uneven light", gradient=0.7),
            PictureCase("half hidden", hidden=0.5),
            PictureCase("16 bits, noise 1", noise_dn=1.0, bits=16),
        ),
    ),
    BoardScene("slant 55 to 60", (55.0, 60.0), (0.7, 1.3), (SHARP, PictureCase("blur 1.5", blur_px=1.5))),
    BoardScene("1.6 to 2.4 m", (0.0, 40.0), (1.6, 2.4), (SHARP, PictureCase("noise 5", noise_dn=5.0))),
    BoardScene("3 to 4.5 m", (0.0, 40.0), (3.0, 4.5), (PictureCase("blur 0.5, noise 2", blur_px=0.5),)),
    BoardScene("0.45 to 0.6 m", (0.0, 40.0), (0.45, 0.6), (SHARP,)),
)


@dataclass(frozen=True)
class PoseTask:
    """One board at one pose of a scene, in all its cases."""

    kind: str
    scene: BoardScene
    pose: int
    seed: int


@dataclass(frozen=True)
class CornersOutcome:
    """One picture: errors (n, 2) px, sigmas (n,), corners in view, OpenCV's errors, the reason if none."""

    errors_px: FloatArray
    sigma_px: FloatArray
    in_view: int
    theirs_px: FloatArray
    reason: str


def hide(rng: np.random.Generator, image: Levels, truth: FloatArray, part: float) -> NDArray[np.bool_]:
    """Lay something over a side of the board, and return which corners are not under it."""
    if not part:
        return np.ones(len(truth), dtype=bool)
    way = rng.uniform(0, 2 * np.pi)
    normal = np.array([np.cos(way), np.sin(way)])
    edge = float(np.quantile(truth @ normal, part))
    y, x = np.mgrid[: image.shape[0], : image.shape[1]]
    under = x * normal[0] + y * normal[1] < edge
    cloth = cv2.GaussianBlur(rng.integers(0, 256, image.shape).astype(np.float32), (0, 0), 3.0)
    image[under] = np.clip(120 + 4 * (cloth - cloth.mean()), 0, 255).astype(image.dtype)[under]
    return np.asarray(truth @ normal > edge + 1.0)


def opencvs(board: AnyBoard, image: Image, truth: FloatArray) -> FloatArray:
    """Return the errors (n, 2) of OpenCV's own detector, for a ChArUco board."""
    if not isinstance(board, Charuco):
        return np.empty((0, 2))
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
    theirs = cv2.aruco.CharucoBoard((board.columns, board.rows), board.square_m, board.marker_m, dictionary)
    corners, ids, _, _ = cv2.aruco.CharucoDetector(theirs).detectBoard(image)
    if ids is None:
        return np.empty((0, 2))
    return np.asarray(np.reshape(corners, (-1, 2)) - truth[np.ravel(ids)], dtype=np.float64)


def run_pose(task: PoseTask) -> dict[str, CornersOutcome]:
    """Draw a board, photograph it in every case, and find its corners."""
    board, scene = BOARDS[task.kind], task.scene
    rng = np.random.default_rng([task.seed, task.pose, *task.kind.encode(), *scene.name.encode()])
    marked = task.kind in ("charuco", "aprilgrid")
    low, high = scene.range_m
    range_m = scene.range_m if marked else (max(low, WHOLE_M[0]), max(high, WHOLE_M[1]))
    # without markers the upper side in the picture is taken for the board's
    one = placed(rng, board, scene.slant_deg, range_m, 0.35 if marked else 0.1, 180.0 if marked else 20.0)
    fine, truth = light(one), one.truth_px
    outcomes = {}
    for case in scene.cases:
        if case.hidden and not marked:
            continue
        image = photographed(rng, fine, case)
        seen = hide(rng, image, truth, case.hidden)
        rim = 2.0 * case.blur_px + 1.0
        seen &= ((truth > rim) & (truth < np.array(SIZE_PX) - 1 - rim)).all(axis=1)
        found = find_corners(one.board, image)
        eight = image.astype(np.uint8) if case.bits == 8 else (image / 200.0).astype(np.uint8)
        theirs = opencvs(board, eight, truth)
        if isinstance(found, CornersNotFound):
            errors, sigma_px, reason = np.empty((0, 2)), np.empty(0), found.reason
        else:
            errors, sigma_px, reason = found.pixels_px - truth[found.ids], found.sigma_px, ""
        outcomes[case.name] = CornersOutcome(errors, sigma_px, int(seen.sum()), theirs, reason)
    return outcomes


COLUMNS = {
    "board": "{kind}", "scene": "{scene}", "pictures": "{case}", "%": "{percent:.0f}", "rms": "{rms_px:.4f}",
    "worst": "{worst_px:.3f}", "rms/sigma": "{ratio:.2f} ± {unsure:.2f}", "wrong": "{wrong}",
    "not found": "{lost} of {of}", "OpenCV": "{theirs_px:.4f}", "its wrong": "{theirs_wrong}",
}  # fmt: skip


def row_of(kind: str, scene: str, case: str, outcomes: list[CornersOutcome]) -> dict[str, object]:
    """Return the row of a case; ± is two standard errors, from the scatter of whole pictures."""
    errors = np.concatenate([o.errors_px for o in outcomes])
    theirs = np.concatenate([o.theirs_px for o in outcomes])
    near = theirs[np.abs(theirs).max(axis=1, initial=0.0) < OUTLIER_PX]
    # of each picture: its corners share a pose, so pictures are what is independent
    read = [o for o in outcomes if len(o.errors_px)]
    squares = np.array([np.mean((o.errors_px / o.sigma_px[:, None]) ** 2) for o in read])
    lost = [o.reason for o in outcomes if o.reason]
    row: dict[str, object] = {
        "kind": kind,
        "scene": scene,
        "case": case,
        "wrong": int((np.abs(errors).max(axis=1, initial=0.0) > OUTLIER_PX).sum()),
        "lost": len(lost),
        "of": len(outcomes),
        "theirs_px": rms(near) if len(near) else None,
        "theirs_wrong": len(theirs) - len(near),
        "reasons": [f"{lost.count(reason)} not found: {reason}" for reason in sorted(set(lost))],
    }
    if len(errors):
        row |= {"percent": 100 * len(errors) / max(1, sum(o.in_view for o in outcomes))}
        row |= {"rms_px": rms(errors), "worst_px": float(np.abs(errors).max())}
        ratio = float(np.sqrt(squares.mean()))
        sd = float(squares.std(ddof=1)) if len(squares) > 1 else np.nan
        row |= {"ratio": ratio, "unsure": sd / np.sqrt(len(squares)) / ratio}
    return row


def main() -> int:
    """Run the campaign and print its table."""
    parser = options(__doc__, 20, "poses of each board in each scene", as_json=True)
    parser.add_argument("--kind", choices=sorted(BOARDS), help="one kind of board only")
    args = parser.parse_args()
    tasks = [
        PoseTask(kind, scene, pose, args.seed)
        for kind in BOARDS
        for scene in SCENES
        if args.kind in (None, kind)
        for pose in range(args.cases)
    ]
    founds = results_of(args, "poses", run_pose, tasks, lambda t: f"{t.kind}, {t.scene.name}, {t.pose}")
    by_case: dict[tuple[str, str, str], list[CornersOutcome]] = {}
    for task, outcomes in zip(tasks, founds, strict=True):
        for case, outcome in outcomes.items():
            by_case.setdefault((task.kind, task.scene.name, case), []).append(outcome)
    rows = [row_of(*case, outcomes) for case, outcomes in by_case.items()]
    show(args, rows, COLUMNS, "reasons")
    return 1 if any(row["wrong"] for row in rows) else 0


if __name__ == "__main__":
    end(main)
