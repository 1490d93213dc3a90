"""Time lenses, beside OpenCV in the same run.

    .venv/bin/python -m tools.benchmarks.numeric [--points 100000] [--rounds 7] [--json]

Processor time of one thread; both sides take turns, round by round, and the table has medians. Where OpenCV
has the lens, the results are compared before they are timed.
"""
# ruff: noqa: E402  the number of threads is set before numpy is imported

from __future__ import annotations

import os

for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"

import itertools
import math
import statistics
import time
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np

from calib.geometry.cahvor import CameraModel
from mastctl.cli.options import at_least
from tools.command import end, options, show

TASKS = ("forward", "gradient", "inverse")
OPENCV_LENSES: dict[str, list[float]] = {
    "OPENCV5": [-0.31, 0.12, 0.001, -0.0007, 0.02],
    "OPENCV8": [0.5, 0.1, 0.001, -0.0005, 0.01, 0.8, 0.2, 0.03],
    "OPENCV14": [0.5, 0.1, 0.001, -0.0005, 0.01, 0.8, 0.2, 0.03, 1e-3, -2e-3, 5e-4, 1e-3, 0.02, -0.03],
    "OPENCV_FISHEYE": [-0.02, 0.01, -0.004, 0.0005],
}
ROUND_S = 0.1
"""Calls are repeated to about this time in each round."""
EXACT = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)


def main() -> int:
    """Measure, and print a table or a document."""
    parser = options(__doc__, seed=None, tasks=False, as_json=True)
    parser.add_argument("--points", type=at_least(1), default=100_000, help="of each lens (default 100000)")
    parser.add_argument("--rounds", type=at_least(1), default=7, help="how often each is timed (default 7)")
    args = parser.parse_args()
    show(args, lenses(args.points, args.rounds), LENS_COLUMNS)
    return 0


def navcam(kind: str, e: tuple[float, float, float] = (0, 0, 0)) -> CameraModel:
    """Return a Navcam-like CAHVOR or CAHVORE (type 2) camera, O a little off A."""
    curved = kind == "CAHVORE"
    size, focal = ((1280, 960), 600.0) if curved else ((1024, 1024), 1226.0)
    alpha, beta = 0.003, -0.002
    r = (0.0, 0.05, -0.016) if curved else (0.0003, -0.005, 0.0215)
    cx, cy = size[0] / 2 + 5.3, size[1] / 2 - 7.1
    return CameraModel(
        kind,
        size,
        C=[0, 0, 0],
        A=[0, 0, 1],
        H=[focal, 0, cx],
        V=[0, focal, cy],
        O=[math.sin(alpha) * math.cos(beta), math.sin(beta), math.cos(alpha) * math.cos(beta)],
        R=r,
        E=e,
        cahvore_type=2 if curved else 0,
    )


def opencv_lens(kind: str) -> CameraModel:
    """Return a camera with one of OpenCV's lenses."""
    lens, size = OPENCV_LENSES[kind], (1280, 960)
    focal = 560.0 if kind == "OPENCV_FISHEYE" else 900.0
    matrix = [[focal, 0.0, 645.3], [0.0, focal + 2.0, 472.9], [0.0, 0.0, 1.0]]
    return CameraModel.of_matrix(kind, size, matrix, lens, np.eye(3), np.zeros(3))


def ours(model: CameraModel, task: str, values: np.ndarray) -> np.ndarray:
    """Carry out one task with this project's model."""
    if task == "inverse":
        return model.ray(values).directions
    return model.project_jacobian(values)[1] if task == "gradient" else model.project(values)[0]


def opencvs(model: CameraModel, task: str, values: np.ndarray) -> np.ndarray:
    """Carry out one task by OpenCV, whose projection always computes the derivatives to all parameters."""
    matrix, lens, none = model.camera_matrix, model.distortion, np.zeros(3)
    if model.kind == "OPENCV_FISHEYE":
        if task != "inverse":
            return cv2.fisheye.projectPoints(values[:, None], none, none, matrix, lens)[0]
        return cv2.fisheye.undistortPoints(values[:, None], matrix, lens, criteria=EXACT)
    if task != "inverse":
        return cv2.projectPoints(values, none, none, matrix, lens)[0]
    undistort = getattr(cv2, "undistortPointsIter", None) or cv2.undistortPoints  # the latter since 5.0
    return undistort(values[:, None], matrix, lens, np.eye(3), np.eye(3), EXACT)


def lenses(points: int, rounds: int) -> list[dict[str, Any]]:
    """Return a row for each lens and task: million points a second, and the ratio to OpenCV's."""
    cameras = {
        "CAHVOR": navcam("CAHVOR"),
        "CAHVORE": navcam("CAHVORE", (-0.0036, 0.013, -0.024)),
        "CAHVORE, E = 0": navcam("CAHVORE"),
        **{kind: opencv_lens(kind) for kind in OPENCV_LENSES},
    }
    rng, rows = np.random.default_rng(1), []
    for (name, model), task in itertools.product(cameras.items(), TASKS):
        pixels = rng.uniform(0.0, 1.0, (points, 2)) * (np.array(model.size_px) - 1.0)
        rays = model.ray(pixels)
        values = (
            pixels
            if task == "inverse"
            else rays.origins_m + rng.uniform(1, 50, (points, 1)) * rays.directions
        )
        sides: dict[str, Callable[[int], float]] = {
            "ours": _timed(lambda m=model, t=task, v=values: ours(m, t, v))
        }
        row: dict[str, Any] = {"lens": name, "task": task}
        if name in OPENCV_LENSES:
            sides["cv2"] = _timed(lambda m=model, t=task, v=values: opencvs(m, t, v))
            row["agrees_to"] = _cv2_gap(model, task, values)
        times = in_turns(sides, rounds)
        row |= {f"{side}_per_us": points / seconds / 1e6 for side, seconds in times.items()}
        if "cv2" in times:
            row["over_cv2"] = times["cv2"] / times["ours"]
        rows.append(row)
    return rows


def _cv2_gap(model: CameraModel, task: str, values: np.ndarray) -> float:
    """Return the largest difference to cv2's result: pixels, or slopes of a ray."""
    mine = ours(model, task if task == "inverse" else "forward", values)
    if task == "inverse":
        mine = mine[:, :2] / mine[:, 2:]
    return float(np.abs(opencvs(model, task, values).reshape(-1, 2) - mine).max())


def _timed(call: Callable[[], object]) -> Callable[[int], float]:
    """Return a function of a number of repeats that returns processor seconds a call."""

    def measure(repeats: int) -> float:
        began = time.thread_time()
        for _ in range(repeats):
            call()
        return (time.thread_time() - began) / repeats

    return measure


def in_turns(sides: dict[str, Callable[[int], float]], rounds: int) -> dict[str, float]:
    """Return each side's median seconds a call, timed in alternating rounds."""
    repeats = {name: max(1, min(1000, int(ROUND_S / max(side(1), 1e-9)))) for name, side in sides.items()}
    times = [{name: side(repeats[name]) for name, side in sides.items()} for _ in range(rounds)]
    return {name: statistics.median(row[name] for row in times) for name in sides}


LENS_COLUMNS = {
    "lens": "{lens}", "task": "{task}", "million points/s": "{ours_per_us:.1f}", "cv2": "{cv2_per_us:.1f}",
    "over cv2": "{over_cv2:.1f}", "agrees to": "{agrees_to:.0e}",
}  # fmt: skip
if __name__ == "__main__":
    end(main)
