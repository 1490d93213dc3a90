"""Fit OpenCV's families of lenses with this project, OpenCV and mrcal to the same corners, in one run.

    .venv/bin/python -m tools.against_others.families [--data hil_tests/data/opencv_stereo]
    .venv/bin/python -m tools.against_others.families --board BOARD.yaml PICTURES

Without ``--board`` the corners are those of OpenCV's stereo sample; with it, of a folder with pictures of one
camera. The boards' poses are free. Ours and OpenCV's fit know no focal length; mrcal, which needs a start and
a whole grid, gets a rough one, and the sample only. Rms is over points, x and y together. *image* is the part
of the picture in which OpenCV's lens has rays at all. Its fit holds no number back, and so can end with a
pole or a fold inside the picture; mrcal and this project hold the numbers near those of usual lenses.
"""

from __future__ import annotations

import json
import math
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from calib.adjust.adjustment import Adjustment
from calib.adjust.solver import minimise
from calib.adjust.terms import ImageTerm
from calib.adjust.unknowns import Estimate
from calib.calibrate.starts.views import view_poses
from calib.errors import CalibError
from calib.files import blind_part
from calib.geometry.cahvor import COEFFICIENTS, CameraModel, Kind
from calib.geometry.rigid import Rigid
from calib.targets.board_file import load_board
from calib.targets.boards import Corners
from calib.targets.corners import find_corners
from tools.command import end, options, show

REPOSITORY = Path(__file__).resolve().parents[2]
COLUMNS, ROWS, SQUARE_M = 9, 6, 0.025
NOISE_PX = 0.1
SETTLED = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 200, 1e-12)
ROUGH_FOCAL = 1.2
"""Times OpenCV's focal length: where mrcal's fits start."""
RATIONAL = cv2.CALIB_RATIONAL_MODEL
FLAGS: dict[Kind, int] = {
    "OPENCV4": cv2.CALIB_FIX_K3,
    "OPENCV5": 0,
    "OPENCV8": RATIONAL,
    "OPENCV12": RATIONAL | cv2.CALIB_THIN_PRISM_MODEL,
    "OPENCV14": RATIONAL | cv2.CALIB_THIN_PRISM_MODEL | cv2.CALIB_TILTED_MODEL,
    "OPENCV_FISHEYE": cv2.fisheye.CALIB_RECOMPUTE_EXTRINSIC | cv2.fisheye.CALIB_FIX_SKEW,
}
IN_MRCAL = ("OPENCV4", "OPENCV5", "OPENCV8", "OPENCV12")
WANTED = 1.01
"""Our rms over the others', at most."""
SUFFIXES = {".png", ".jpg", ".jpeg", ".bmp"}
FEWEST, FEWEST_PICTURES = 8, 3


TABLE = {
    "pictures": "{pictures}", "family": "{kind}", "ours px": "{ours_px:.4f}", "OpenCV": "{opencv_px:.4f}",
    "ours over": "{opencv_ratio:.3f}", "image": "{opencv_image:.0%}", "mrcal": "{mrcal_px:.4f}",
    "ours over mrcal": "{mrcal_ratio:.3f}", "s": "{ours_s:.2f}",
    "verdict": "{verdict}", "note": "{note} {about_others}",
}  # fmt: skip


@dataclass(frozen=True)
class FamilyRow:
    """One family: rms of each in pixels, None where there is none, and where OpenCV's lens has rays."""

    pictures: str
    kind: str
    ours_px: float | None
    opencv_px: float | None
    opencv_image: float
    mrcal_px: float | None
    ours_s: float
    note: str = ""
    about_others: str = ""

    @property
    def verdict(self) -> str:
        """Whether our rms is within 1 % of OpenCV's, if its lens serves the whole picture, and of mrcal's.

        A fit with a note (not settled, corners outside the lens) does not count as met.
        """
        beside = [self.mrcal_px] + ([self.opencv_px] if self.opencv_image == 1.0 else [])
        told = [one for one in beside if one]
        if not told:
            return ""
        ours_px = math.inf if self.ours_px is None or self.note else self.ours_px
        return "met" if all(ours_px <= WANTED * one for one in told) else "NOT MET"


@dataclass(frozen=True, eq=False)
class BoardViews:
    """Corners of a chessboard: (54, 3) on the board, metres, and (n, 54, 2) in n pictures, pixels."""

    name: str
    size_px: tuple[int, int]
    in_board_m: np.ndarray
    pixels_px: np.ndarray


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


def rms(residuals_px: np.ndarray) -> float:
    """Root of the mean square length of residuals (..., 2)."""
    return float(np.sqrt(np.mean(np.sum(residuals_px**2, axis=-1))))


def centred(size_px: tuple[int, int], focal_px: float) -> CameraModel:
    """Return a pinhole camera at the origin that looks along z, as CAHVOR."""
    x, y, z = np.eye(3)
    cx, cy = (np.array(size_px) - 1) / 2
    return CameraModel("CAHVOR", size_px, np.zeros(3), z, focal_px * x + cx * z, focal_px * y + cy * z, z)


def boards_problem(views: BoardViews, focal_px: float) -> tuple[Adjustment, Estimate]:
    """Return the project's adjustment of one camera and free boards, and its start."""
    camera = centred(views.size_px, focal_px)
    middle = (np.array(views.size_px) - 1) / 2
    terms, poses = [], {}
    for number, pixels in enumerate(views.pixels_px):
        board = (views.name, str(number))
        slopes = (pixels - middle) / focal_px
        _, turn, shift = cv2.solvePnP(
            views.in_board_m, slopes[:, None], np.eye(3), None, flags=cv2.SOLVEPNP_IPPE
        )
        poses[board] = Rigid(cv2.Rodrigues(turn)[0], shift.ravel())
        count = np.arange(len(pixels))
        terms.append(
            ImageTerm(
                str(number), "camera", board, None, 0.0, 0.0, count // COLUMNS, count % COLUMNS,
                views.in_board_m, pixels, np.full(len(pixels), NOISE_PX), np.ones(len(pixels), dtype=bool),
            )
        )  # fmt: skip
    start = Estimate({"camera": camera}, rover_from_board=poses)
    return Adjustment(terms, (), start, mast_parameters=0, prisms_cad_m={}), start


def boards_residuals(problem: Adjustment, state: Estimate) -> np.ndarray:
    """Return residuals of all corners, (n, 2), pixels."""
    found = [off.reshape(-1, 2) for off in problem.residuals(state, problem.images)]
    return np.concatenate(found) * NOISE_PX


def fit_ours(kind: Kind, size_px: tuple[int, int], terms: Sequence[ImageTerm]) -> tuple[float, str]:
    """Return the rms of our camera and boards, and a note if the fit did not settle; or CalibError."""
    points = [term.in_board_m.astype(np.float32) for term in terms]
    pixels = [term.pixels_px.astype(np.float32) for term in terms]
    found = view_poses(terms, kind, size_px, cv2.initCameraMatrix2D(points, pixels, size_px)[0, 0])
    terms = [term for term in terms if term.name in found.poses]
    boards = {term.board: found.poses[term.name][0] for term in terms}
    start = Estimate({"camera": found.model}, rover_from_board=boards)
    problem = Adjustment(terms, (), start, mast_parameters=0)
    fit = minimise(problem, start, weak=problem.weak)
    left = boards_residuals(problem, fit.state)
    lost = int((~np.isfinite(left).all(axis=1)).sum())
    note = ("" if fit.settled else "ours not settled") + (f" {lost} corners unseen" if lost else "")
    return rms(left[np.isfinite(left).all(axis=1)]), note


def fit_opencv(kind: Kind, size_px: tuple[int, int], terms: Sequence[ImageTerm]) -> tuple[float, CameraModel]:
    """Return the rms of OpenCV's fit, and its camera."""
    points = [term.in_board_m.astype(np.float32) for term in terms]
    pixels = [term.pixels_px.astype(np.float32) for term in terms]
    if kind == "OPENCV_FISHEYE":
        matrix = np.array(
            [[0.8 * size_px[0], 0, size_px[0] / 2], [0, 0.8 * size_px[0], size_px[1] / 2], [0, 0, 1]]
        )
        found, matrix, lens, *_ = cv2.fisheye.calibrate(
            [one[:, None].astype(float) for one in points], [one[:, None].astype(float) for one in pixels],
            size_px, matrix, np.zeros(4), flags=FLAGS[kind] | cv2.fisheye.CALIB_USE_INTRINSIC_GUESS,
            criteria=SETTLED,
        )  # fmt: skip
    else:
        found, matrix, lens, *_ = cv2.calibrateCamera(
            points, pixels, size_px, None, None, flags=FLAGS[kind], criteria=SETTLED
        )
    numbers = lens.ravel()[: COEFFICIENTS[kind]]
    return float(found), CameraModel.of_matrix(kind, size_px, matrix, numbers, np.eye(3), np.zeros(3))


def fit_mrcal(
    kind: Kind, views: BoardViews, focal_px: float, interpreter: str | None
) -> tuple[float | None, str]:
    """Return the rms of mrcal's fit, or why there is none."""
    start = boards_problem(views, focal_px)[1]
    poses = [
        [*Rotation.from_matrix(p.rotation).as_rotvec(), *p.translation_m]
        for p in start.rover_from_board.values()
    ]
    middle = ((np.array(views.size_px) - 1) / 2).tolist()
    request = {
        "lens": f"LENSMODEL_{kind}", "size_px": views.size_px, "boards": poses,
        "pixels": views.pixels_px.tolist(),
        "intrinsics": [focal_px, focal_px, *middle, *[0] * COEFFICIENTS[kind]],
        "columns": COLUMNS, "rows": ROWS, "spacing_m": SQUARE_M,
    }  # fmt: skip
    if interpreter is None:
        return None, "no mrcal"
    done = subprocess.run(
        [interpreter, str(Path(__file__).with_name("mrcal_fit.py"))],
        input=json.dumps(request), capture_output=True, text=True, cwd="/",
    )  # fmt: skip
    if done.returncode:
        return None, f"mrcal ended: {done.stderr.strip()[-80:]}"
    answer = json.loads(done.stdout.splitlines()[-1])
    if "refused" in answer:
        return None, f"refused: {answer['refused']}"
    return rms(np.array(answer["pixels"]) - views.pixels_px.reshape(-1, 2)), ""


def find_mrcal() -> str | None:
    """Return the first interpreter that has mrcal."""
    for interpreter in (sys.executable, "/usr/bin/python3"):
        probe = [interpreter, "-c", "import mrcal"]
        if Path(interpreter).exists() and not subprocess.run(probe, capture_output=True, cwd="/").returncode:
            return interpreter
    return None


def sample_terms(views: BoardViews) -> list[ImageTerm]:
    """Return the sample's corners as the bench has them: about the board's centre."""
    centred_m = views.in_board_m - views.in_board_m[[0, -1]].mean(axis=0)
    return [
        replace(term, in_board_m=centred_m)
        for term in boards_problem(views, float(max(views.size_px)))[0].images
    ]


def folder_terms(board_file: Path, folder: Path) -> tuple[tuple[int, int], list[ImageTerm]]:
    """Return the pictures' size, and our corners of the board in each that shows enough of it."""
    board, terms, size_px = load_board(board_file), [], (0, 0)
    for path in sorted(path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES):
        grey = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        if grey is None:
            continue
        size_px = (grey.shape[1], grey.shape[0])
        found = find_corners(board, grey)
        if not isinstance(found, Corners) or len(found.ids) < FEWEST:
            continue
        rows, columns = board.cells(found.ids)
        places, count = board.in_board_m(found.ids), len(found.ids)
        terms.append(
            ImageTerm(
                path.name, "camera", ("", path.name), None, 0.0, 0.0, rows, columns, places,
                found.pixels_px, np.full(count, NOISE_PX), np.ones(count, dtype=bool),
            )
        )  # fmt: skip
    return size_px, terms


def compare(
    name: str, size_px: tuple[int, int], terms: Sequence[ImageTerm], views: BoardViews | None
) -> list[FamilyRow]:
    """Fit every family."""
    interpreter = find_mrcal() if views is not None else None
    rows = []
    for kind in FLAGS:
        others, opencv_px, seen = [], None, 0.0
        try:
            opencv_px, camera = fit_opencv(kind, size_px, terms)
            seen = 1.0 - blind_part(camera)
        except cv2.error as reason:
            others.append(f"OpenCV: {reason.err}")
        start_s = time.thread_time()
        try:
            ours_px, note = fit_ours(kind, size_px, terms)
        except CalibError as reason:
            ours_px, note = None, str(reason)
        taken_s = time.thread_time() - start_s
        mrcal_px = None
        if views is not None and kind in IN_MRCAL:
            mrcal_px, why = fit_mrcal(
                kind, views, ROUGH_FOCAL * float(camera.camera_matrix[0, 0]), interpreter
            )
            others += [why] if why else []
        rows.append(
            FamilyRow(name, kind, ours_px, opencv_px, seen, mrcal_px, taken_s, note, "; ".join(others))
        )
    return rows


def _as_row(row: FamilyRow) -> dict[str, object]:
    over = {
        f"{name}_ratio": row.ours_px / px
        for name, px in (("opencv", row.opencv_px), ("mrcal", row.mrcal_px))
        if px and row.ours_px
    }
    return asdict(row) | over | {"verdict": row.verdict}


def main() -> int:
    """Compare and print; exit code 1 if our rms is more than 1 % above another's, or there is none."""
    parser = options(__doc__, seed=None, as_json=True, tasks=False)
    sample = REPOSITORY / "hil_tests" / "data" / "opencv_stereo"
    parser.add_argument(
        "--data", type=Path, default=sample, help="OpenCV's stereo sample, left*.jpg and right*.jpg"
    )
    parser.add_argument("--board", type=Path, help="BOARD.yaml of the pictures in FOLDER")
    parser.add_argument("folder", type=Path, nargs="?", help="pictures of one camera and one board")
    arguments = parser.parse_args()
    if (arguments.board is None) != (arguments.folder is None):
        parser.error("--board and FOLDER go together")
    cv2.setNumThreads(1)
    rows: list[FamilyRow] = []
    if arguments.board is not None:
        size_px, terms = folder_terms(arguments.board, arguments.folder)
        if len(terms) < FEWEST_PICTURES:
            parser.error(
                f"{arguments.folder}: {len(terms)} pictures show {FEWEST} corners of the board or more, "
                f"{FEWEST_PICTURES} are expected"
            )
        rows += compare(arguments.folder.name, size_px, terms, None)
    else:
        for side in ("left", "right"):
            try:
                views = read_views(arguments.data, side)
            except FileNotFoundError as error:
                parser.error(str(error))
            rows += compare(side, views.size_px, sample_terms(views), views)
    show(arguments, [_as_row(row) for row in rows], TABLE)
    return 0 if all(row.verdict != "NOT MET" for row in rows) else 1


if __name__ == "__main__":
    end(main)
