"""Fit cameras to the same points with this project, OpenCV, mrcal and plain SciPy, in one run on one thread.

    .venv/bin/python -m tools.against_others.calibration --data ../shared/data/opencv_stereo [--surveys 20]

Three problems, each given to all who can solve it:

- a chessboard in 13 pictures, the boards' poses free (left, then right camera of OpenCV's stereo sample);
- its corners as fixed points: the boards stand where OpenCV's calibration puts them, only the camera is free;
- a simulated survey: the simulator's true left Navcam (rows and columns made square to each other, which
  mrcal takes for granted), boards at 3 and 6 m, dots with 0.1 px noise. Here the truth is known: the error is
  that of predicted pixels over the whole picture at 3, 6 and 10 m.

All fits of a problem that need a start have the same one, a pinhole with a rough focal length; OpenCV makes
its own, fit_camera seeks its own, and so does a bench (``calib.calibrate.starts.views``), which knows no
focal length. SciPy's least_squares gets residuals alone and differences them: once as it comes (trf), once by
its quickest method (lm) with unknowns scaled by hand; where all poses are free, it is spared the six unknowns
that only move everything together. Rms is over points (x and y together), as OpenCV tells it. Times are
processor times of one fit, medians of --rounds. mrcal is used where this interpreter, or Debian's
/usr/bin/python3, can import it (apt-get install --no-install-recommends python3-mrcal).
"""
# ruff: noqa: E402  the number of threads is set before numpy is imported

from __future__ import annotations

import os

for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"

import argparse
import json
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np
from scipy.optimize import OptimizeResult, least_squares
from scipy.spatial.transform import Rotation

from calib.adjust.adjustment import Adjustment
from calib.adjust.solver import minimise
from calib.adjust.terms import ImageTerm
from calib.adjust.unknowns import Estimate
from calib.calibrate.starts.camera import FixedPoints, fit_camera, pinhole
from calib.calibrate.starts.views import view_poses
from calib.geometry.cahvor import CameraModel
from calib.geometry.parameters import parameter_names, parameter_part, stepped
from calib.geometry.rigid import Rigid
from mastctl.cli.output import at_least
from tools.against_others.points import (
    COLUMNS,
    NOISE_PX,
    REPOSITORY,
    ROWS,
    SQUARE_M,
    BoardViews,
    Points,
    opencv_views,
    read_views,
    simulated_survey,
    views_as_points,
)  # fmt: skip
from tools.command import end

T = TypeVar("T")
ROUGH_FOCAL = 1.2
"""Times the true (or OpenCV's) focal length: where fits with a start begin."""
WORST_RATIO = 1.02
"""Our rms over OpenCV's, at most."""
LOST_PX = 1e3
"""Residual of a point without a pixel, for SciPy, which wants a number."""


@dataclass(frozen=True)
class FitRow:
    """One fit: rms of its residuals and, where the truth is known, of its predictions; None where refused."""

    problem: str
    method: str
    parameters: int
    rms_px: float | None
    error_px: float | None
    milliseconds: float | None
    note: str = ""


def rms(residuals_px: np.ndarray) -> float:
    """Root of the mean square length of residuals (..., 2)."""
    return float(np.sqrt(np.mean(np.sum(residuals_px**2, axis=-1))))


def timed(fit: Callable[[], T], rounds: int) -> tuple[T, float]:
    """Return what a fit returns and the median processor time of one, milliseconds."""
    times = []
    for _ in range(rounds):
        start = time.thread_time()
        result = fit()
        times.append(1e3 * (time.thread_time() - start))
    return result, statistics.median(times)


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
    start = Estimate({"camera": camera}, np.zeros(8), {}, poses, {}, np.zeros((0, 2)))
    return Adjustment(terms, (), start, mast_parameters=0, prisms_cad_m={}), start


def from_pictures_alone(views: BoardViews) -> float:
    """Return the rms of the camera that a bench's fit starts with, nothing of its lens being known."""
    centred_m = views.in_board_m - views.in_board_m[[0, -1]].mean(axis=0)
    terms = [
        replace(term, in_board_m=centred_m)
        for term in boards_problem(views, float(max(views.size_px)))[0].images
    ]
    found = view_poses(terms, "CAHVOR", views.size_px, None)
    boards = {term.board: found.poses[term.name][0] for term in terms}
    start = Estimate({"camera": found.model}, np.zeros(8), {}, boards, {}, np.zeros((0, 2)))
    problem = Adjustment(terms, (), start, mast_parameters=0)
    return rms(boards_residuals(problem, minimise(problem, start, weak=problem.weak).state))


def gauges() -> list[int]:
    """Return where the camera's parameters are that boards with free poses leave open: C, A and V.x."""
    parts = [parameter_part("CAHVOR", letter) for letter in "CA"]
    return [*(i for part in parts for i in range(part.start, part.stop)), parameter_part("CAHVOR", "V").start]


def scipy_ways(weak: np.ndarray) -> tuple[tuple[str, dict], ...]:
    """Return names and options of SciPy's fits; ``weak`` scales pixels against metres."""
    return (
        ("SciPy trf CAHVOR", {}),
        ("SciPy lm CAHVOR", {"method": "lm", "x_scale": weak**-0.5}),
    )


def told(plain: OptimizeResult) -> str:
    """Return how often SciPy asked for residuals to step (less those of differences)."""
    return f"{plain.nfev} evaluations{'' if plain.success else ', not settled'}"


def boards_residuals(problem: Adjustment, state: Estimate) -> np.ndarray:
    """Return residuals of all corners, (n, 2), pixels."""
    found = [problem.image_residual(state, term).reshape(-1, 2) for term in problem.images]
    return np.concatenate(found) * NOISE_PX


def compare_views(views: BoardViews, rounds: int, mrcal: str | None) -> list[FitRow]:
    """Fit a camera and the boards' poses."""
    name = f"{views.name}: {len(views.pixels_px)} boards, free"
    poses = 6 * len(views.pixels_px)
    rows = []
    for label, flags, lens in (
        ("OpenCV k1 k2 p1 p2", cv2.CALIB_FIX_K3, 4),
        ("OpenCV k1 k2 p1 p2 k3", 0, 5),
    ):
        (found, matrix, *_), taken = timed(lambda flags=flags: opencv_views(views, flags), rounds)
        rows.append(FitRow(name, label, poses + 4 + lens, float(found), None, taken))
    focal = ROUGH_FOCAL * float(matrix[0, 0])
    problem, start = boards_problem(views, focal)
    fit, taken = timed(lambda: minimise(problem, start, weak=problem.weak), rounds)
    count = len(parameter_names("CAHVOR")) + poses - len(gauges())
    rows.insert(0, FitRow(name, "ours CAHVOR", count, rms(boards_residuals(problem, fit.state)), None, taken))

    alone, taken = timed(lambda: from_pictures_alone(views), rounds)
    note = "bench: no focal length known"
    rows.insert(1, FitRow(name, "ours, from nothing", count, alone, None, taken, note))

    moving = np.setdiff1d(np.arange(len(problem.names)), gauges())

    def residual(step: np.ndarray) -> np.ndarray:
        whole = np.zeros(len(problem.names))
        whole[moving] = step
        try:
            found = boards_residuals(problem, problem.stepped(start, whole)).ravel()
        except ValueError:  # no camera
            return np.full(views.pixels_px.size, LOST_PX)
        return np.nan_to_num(found, nan=LOST_PX)

    for label, options in scipy_ways(problem.weak[moving]):
        plain, taken = timed(
            lambda options=options: least_squares(residual, np.zeros(len(moving)), **options), 1
        )
        rows.append(FitRow(name, label, count, rms(plain.fun.reshape(-1, 2)), None, taken, told(plain)))
    first = [np.concatenate([Rotation.from_matrix(p.rotation).as_rotvec(), p.translation_m])
             for p in start.rover_from_board.values()]  # fmt: skip
    middle = ((np.array(views.size_px) - 1) / 2).tolist()
    for label, lens, lens_count in (
        ("mrcal CAHVOR", "LENSMODEL_CAHVOR", 5),
        ("mrcal OPENCV5", "LENSMODEL_OPENCV5", 5),
    ):
        request = {
            "lens": lens, "size_px": views.size_px, "intrinsics": [focal, focal, *middle, *[0] * lens_count],
            "boards": np.array(first).tolist(), "pixels": views.pixels_px.tolist(),
            "columns": COLUMNS, "rows": ROWS, "spacing_m": SQUARE_M, "rounds": rounds,
        }  # fmt: skip
        # R0 is one of mrcal's nine numbers, and a gauge.
        rows.append(
            mrcal_row(name, label, poses + 4 + lens_count - ("CAHVOR" in lens), mrcal, request,
                      views.pixels_px.reshape(-1, 2))
        )  # fmt: skip
    return rows


def mrcal_row(
    name: str, label: str, parameters: int, interpreter: str | None, request: dict, pixels_px: np.ndarray,
    truth_px: np.ndarray | None = None,
) -> FitRow:  # fmt: skip
    """Let mrcal fit, or say why it did not."""
    if interpreter is None:
        return FitRow(name, label, parameters, None, None, None, "no mrcal")
    done = subprocess.run(
        [interpreter, str(Path(__file__).with_name("mrcal_fit.py"))],
        input=json.dumps(request), capture_output=True, text=True, cwd="/",
    )  # fmt: skip
    if done.returncode:
        return FitRow(name, label, parameters, None, None, None, f"mrcal ended: {done.stderr.strip()[-80:]}")
    answer = json.loads(done.stdout.splitlines()[-1])
    if "refused" in answer:
        return FitRow(name, label, parameters, None, None, None, f"refused: {answer['refused']}")
    error = None if truth_px is None else rms(np.array(answer["probe"]) - truth_px)
    found = rms(np.array(answer["pixels"]) - pixels_px)
    return FitRow(name, label, parameters, found, error, 1e3 * answer["seconds"])


def compare_points(points: Points, rounds: int, mrcal: str | None) -> list[FitRow]:
    """Fit a camera to fixed points."""
    focal = ROUGH_FOCAL * points.focal_px
    # SQPnP on every ninth point, as fit_camera would start from.
    few = slice(None, None, 9)
    start = pinhole(points.points_m[few], points.pixels_px[few], "CAHVOR", points.size_px, focal)
    if start is None:
        raise SystemExit(f"{points.name}: no pinhole camera sees the points; nothing is compared")
    count = len(parameter_names("CAHVOR"))

    def row(label: str, model: CameraModel, taken: float, note: str = "") -> FitRow:
        error = rms(model.project(points.probe_m)[0] - points.truth_px) if len(points.probe_m) else None
        left = rms(model.project(points.points_m)[0] - points.pixels_px)
        return FitRow(points.name, label, count, left, error, taken, note)

    problem = FixedPoints(points.points_m, points.pixels_px, np.full(len(points.points_m), NOISE_PX))
    weak = np.ones(count)
    for letter in "HV":
        weak[parameter_part("CAHVOR", letter)] = 1 / float(start.H @ start.H)
    fit, taken = timed(lambda: minimise(problem, start, weak=weak), rounds)
    rows = [row("ours CAHVOR", fit.state, taken)]
    whole, taken = timed(
        lambda: fit_camera(
            points.points_m, points.pixels_px, points.images, kind="CAHVOR", size_px=points.size_px,
            focal_px=focal, sigma_px=NOISE_PX, expected_px=0.5,
        ),
        rounds,
    )  # fmt: skip
    note = f"start sought, {int((~whole.used).sum())} points left out"
    rows.append(row("ours, fit_camera", whole.model, taken, note))

    def residual(step: np.ndarray) -> np.ndarray:
        try:
            seen, _ = stepped(start, step).project(points.points_m)
        except ValueError:  # no camera
            return np.full(points.pixels_px.size, LOST_PX)
        return np.nan_to_num((seen - points.pixels_px).ravel(), nan=LOST_PX)

    for label, options in scipy_ways(weak):
        plain, taken = timed(
            lambda options=options: least_squares(residual, np.zeros(count), **options), rounds
        )
        rows.append(row(label, stepped(start, plain.x), taken, told(plain)))
    axes = np.stack([np.cross(np.cross(start.A, start.H), start.A), np.cross(start.A, start.H), start.A])
    axes[:2] /= np.linalg.norm(axes[:2], axis=1)[:, None]
    pose = [*Rotation.from_matrix(axes).as_rotvec(), *(-axes @ start.C)]
    intrinsics = [focal, focal, *((np.array(points.size_px) - 1) / 2), *[0] * 5]
    request = {
        "lens": "LENSMODEL_CAHVOR", "size_px": points.size_px, "intrinsics": intrinsics,
        "points": points.points_m.tolist(), "pixels": points.pixels_px.tolist(), "camera_from_points": pose,
        "probe": points.probe_m.tolist(), "rounds": rounds,
    }  # fmt: skip
    truth = points.truth_px if len(points.probe_m) else None
    rows.append(mrcal_row(points.name, "mrcal CAHVOR", count - 1, mrcal, request, points.pixels_px, truth))
    return rows


def pooled(runs: Sequence[Sequence[FitRow]]) -> list[FitRow]:
    """Return one row a method: rms over runs, median time."""
    rows = []
    for same in zip(*runs, strict=True):
        if any(r.rms_px is None for r in same):
            rows.append(next(r for r in same if r.rms_px is None))
            continue
        left, error = (
            float(np.sqrt(np.mean([getattr(r, key) ** 2 for r in same]))) for key in ("rms_px", "error_px")
        )
        taken = statistics.median(r.milliseconds for r in same if r.milliseconds is not None)
        note = f"{len(same)} surveys" + ("; " + same[0].note if same[0].note else "")
        rows.append(replace(same[0], rms_px=left, error_px=error, milliseconds=taken, note=note))
    return rows


def find_mrcal() -> str | None:
    """Return the first interpreter that has mrcal."""
    for interpreter in (sys.executable, "/usr/bin/python3"):
        probe = [interpreter, "-c", "import mrcal"]
        if Path(interpreter).exists() and not subprocess.run(probe, capture_output=True, cwd="/").returncode:
            return interpreter
    return None


def print_table(rows: Sequence[FitRow], mrcal: str | None) -> None:
    """Print rows by problem; ratios are to the first row of a problem, ours."""
    print("mrcal: none found, its rows are empty" if mrcal is None else f"mrcal: of {mrcal}")
    first = rows[0]
    for number, row in enumerate(rows):
        if number == 0 or row.problem != rows[number - 1].problem:
            first = row
            print(f"\n{row.problem}\n{'method':22} free   rms px  to ours error px       ms  to ours")
        cells = ["-"] * 5
        if row.rms_px is not None and row.milliseconds is not None:
            cells[0], cells[1] = f"{row.rms_px:.4f}", f"{row.rms_px / (first.rms_px or np.nan):.4f}"
            cells[2] = "-" if row.error_px is None else f"{row.error_px:.4f}"
            cells[3] = f"{row.milliseconds:.1f}"
            cells[4] = f"{row.milliseconds / (first.milliseconds or np.nan):.2f}"
        numbers = " ".join(f"{cell:>8}" for cell in cells)
        print(f"{row.method:22} {row.parameters:4d} {numbers}  {row.note}")


def verdicts(rows: Sequence[FitRow]) -> list[dict[str, object]]:
    """Return for every problem with OpenCV in it our rms over each of OpenCV's."""
    found: list[dict[str, object]] = []
    for mine in rows:
        if mine.method not in ("ours CAHVOR", "ours, from nothing") or not mine.rms_px:
            continue
        for row in rows:
            if row.problem == mine.problem and row.method.startswith("OpenCV") and row.rms_px:
                ratio = mine.rms_px / row.rms_px
                found.append({"problem": row.problem, "ours": mine.method, "against": row.method,
                              "ratio": ratio, "met": ratio <= WORST_RATIO})  # fmt: skip
    return found


def main() -> int:
    """Compare and print; exit code 1 if our rms is more than 2 % above OpenCV's."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--data",
        type=Path,
        default=REPOSITORY.parent / "shared" / "data" / "opencv_stereo",
        help="folder of OpenCV's stereo sample pictures, left*.jpg and right*.jpg",
    )
    parser.add_argument("--surveys", type=at_least(1), default=20, help="simulated surveys (default 20)")
    parser.add_argument("--rounds", type=at_least(1), default=5, help="how often a fit is timed (default 5)")
    parser.add_argument("--json", action="store_true", help="print one JSON document instead of tables")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    mrcal = find_mrcal()
    rows: list[FitRow] = []
    try:
        sides = [read_views(arguments.data, side) for side in ("left", "right")]
    except FileNotFoundError as error:
        parser.error(str(error))
    for views in sides:
        rows += compare_views(views, arguments.rounds, mrcal)
    for views in sides:
        rows += compare_points(views_as_points(views), arguments.rounds, mrcal)
    runs = [
        compare_points(simulated_survey(seed), arguments.rounds, mrcal) for seed in range(arguments.surveys)
    ]
    rows += pooled(runs)
    judged = verdicts(rows)
    if arguments.json:
        print(json.dumps({"mrcal": mrcal, "rows": [asdict(r) for r in rows], "verdicts": judged}, indent=1))
    else:
        print_table(rows, mrcal)
        print()
        for one in judged:
            told_ratio = f"{one['ratio']:.4f}, at most {WORST_RATIO}: {'met' if one['met'] else 'NOT MET'}"
            print(f"{one['problem']}: {one['ours']} / {one['against']} = {told_ratio}")
    return 0 if all(one["met"] for one in judged) else 1


if __name__ == "__main__":
    end(main)
