"""Time the camera models and the pointing solution, beside mrcal, OpenCV and SciPy, in one run, one thread.

    .venv/bin/python -m tools.benchmarks.geometry [--rounds 7] [--json]

Times are processor times of the one thread, so that other work on the machine counts little; both sides take
turns, round by round, and the table has medians.

mrcal is used where this interpreter, or Debian's /usr/bin/python3, can import it (apt-get install
--no-install-recommends python3-mrcal). It has no oblique H and V, so the cameras here have none. The results
are compared before they are timed: where E is not 0, Debian's mrcal 2.2 differs by pixels, and the vectors of
JPL's own library, which the tests hold this project to, do not.

cv2 has OpenCV's families. Its projections give the derivatives to all parameters too, wanted or not; its
inverse is told to go on until a step is below 1e-12, for by itself it ends after five.
"""
# ruff: noqa: E402  the number of threads is set before numpy is imported

from __future__ import annotations

import os

for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"

import argparse
import itertools
import json
import math
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np
from scipy.optimize import least_squares

from calib.geometry.cahvor import CameraModel
from calib.geometry.pointing import solve
from calib.geometry.rig import Mast
from calib.geometry.rigid import Rigid, rot_x, rot_y, rot_z
from mastctl.cli.output import at_least
from tools.command import end

COUNTS = (1_000, 100_000, 1_000_000)
SAME = {"forward": 1e-6, "gradient": 1e-3, "inverse": 1e-7}
SAME_RAD = 1e-6
WANTED = {("CAHVOR", "forward"): 4.0, ("CAHVOR", "gradient"): 2.5, ("CAHVOR", "inverse"): 10.0}
WANTED[("CAHVORE", "forward")] = 1.0
KINDS: dict[str, list[float]] = {
    "OPENCV4": [-0.31, 0.12, 0.001, -0.0007],
    "OPENCV5": [-0.31, 0.12, 0.001, -0.0007, 0.02],
    "OPENCV8": [0.5, 0.1, 0.001, -0.0005, 0.01, 0.8, 0.2, 0.03],
    "OPENCV12": [0.5, 0.1, 0.001, -0.0005, 0.01, 0.8, 0.2, 0.03, 1e-3, -2e-3, 5e-4, 1e-3],
    "OPENCV14": [0.5, 0.1, 0.001, -0.0005, 0.01, 0.8, 0.2, 0.03, 1e-3, -2e-3, 5e-4, 1e-3, 0.02, -0.03],
    "OPENCV_FISHEYE": [-0.02, 0.01, -0.004, 0.0005],
}
"""OpenCV's families, and coefficients for each."""
WANTED |= {
    (kind, task): WANTED["CAHVOR", task] for kind in KINDS for task in ("forward", "gradient", "inverse")
}
WANTED_FEW = {"forward": 3.0, "gradient": 2.5, "inverse": 8.0}
"""At a thousand points, where a call's own time counts."""
WANTED_POINTING_US = {"a = 0": 60.0, "a = 0.05 m": 150.0}
WANTED_POINTING_RATIO = 10.0
POINTINGS = 400
ROUND_S = 0.1
"""Calls are repeated to about this time in each round."""
EXACT = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)
LONGEST_S = 10.0
"""A longer call of mrcal is left out and its time told (its CAHVORE inverse is a loop over the points)."""


@dataclass(frozen=True)
class GeometryRow:
    """One line of the table of camera models; rates in million points a second. The ratio is to mrcal, to cv2
    where mrcal has no such lens."""

    camera: str
    task: str
    points: int
    rate: float
    mrcal_rate: float | None
    cv2_rate: float | None
    ratio: float | None
    wanted: float | None
    note: str

    @property
    def verdict(self) -> str:
        """Whether what was wanted is met."""
        if self.wanted is None or self.ratio is None:
            return ""
        return "met" if self.ratio >= self.wanted else "NOT MET"


@dataclass(frozen=True)
class PointingRow:
    """One line of the table of pointing solutions; microseconds each."""

    mast: str
    solve_us: float
    wanted_us: float
    least_squares_us: float
    ratio: float
    levenberg_us: float
    levenberg_ratio: float

    @property
    def verdict(self) -> str:
        """Whether both the time and the ratio are met."""
        missed = [
            word
            for word, good in (
                ("time", self.solve_us < self.wanted_us),
                ("ratio", self.ratio >= WANTED_POINTING_RATIO),
            )
            if not good
        ]
        return f"NOT MET ({', '.join(missed)})" if missed else "met"


@dataclass(frozen=True)
class TimedCamera:
    """A camera in its own frame, with mrcal's name and numbers for it."""

    name: str
    model: CameraModel
    lens: str
    intrinsics: list[float]


def bench_camera(name: str, kind: str, e: tuple[float, float, float]) -> TimedCamera:
    """Return a Navcam-like camera, O a little off A; ``e`` counts for CAHVORE (type 2)."""
    curved = kind == "CAHVORE"
    size, focal = ((1280, 960), 600.0) if curved else ((1024, 1024), 1226.0)
    alpha, beta = 0.003, -0.002
    r = (0.0, 0.05, -0.016) if curved else (0.0003, -0.005, 0.0215)
    cx, cy = size[0] / 2 + 5.3, size[1] / 2 - 7.1
    model = CameraModel(
        kind,  # type: ignore[arg-type]
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
    numbers = [focal, focal, cx, cy, alpha, beta, *r]
    lens = "LENSMODEL_CAHVORE_linearity=0.000" if curved else "LENSMODEL_CAHVOR"
    return TimedCamera(name, model, lens, numbers + list(e) if curved else numbers)


def opencv_camera(kind: str) -> TimedCamera:
    """Return a camera with one of OpenCV's lenses; mrcal has those of up to 12 coefficients."""
    lens, size = KINDS[kind], (1280, 960)
    focal = 560.0 if kind == "OPENCV_FISHEYE" else 900.0
    matrix = [[focal, 0.0, 645.3], [0.0, focal + 2.0, 472.9], [0.0, 0.0, 1.0]]
    model = CameraModel.of_matrix(kind, size, matrix, lens, np.eye(3), np.zeros(3))  # type: ignore[arg-type]
    known = kind in ("OPENCV4", "OPENCV5", "OPENCV8", "OPENCV12")
    return TimedCamera(
        kind, model, f"LENSMODEL_{kind}" if known else "", [focal, focal + 2.0, 645.3, 472.9, *lens]
    )


def run_cv2(model: CameraModel, task: str, values: np.ndarray) -> np.ndarray:
    """Carry out one task by OpenCV, in a camera's own frame."""
    matrix, lens, none = model.camera_matrix, model.distortion, np.zeros(3)
    if model.kind == "OPENCV_FISHEYE":
        if task != "inverse":
            return cv2.fisheye.projectPoints(values[:, None], none, none, matrix, lens)[0]
        return cv2.fisheye.undistortPoints(values[:, None], matrix, lens, criteria=EXACT)
    if task != "inverse":
        return cv2.projectPoints(values, none, none, matrix, lens)[0]
    undistort = getattr(cv2, "undistortPointsIter", None) or cv2.undistortPoints  # the latter since 5.0
    return undistort(values[:, None], matrix, lens, np.eye(3), np.eye(3), EXACT)


class Mrcal:
    """mrcal in an interpreter of its own; construction starts it, leaving ends it."""

    def __init__(self, interpreter: str, folder: Path) -> None:
        self._folder = folder
        self._process = subprocess.Popen(
            [interpreter, str(Path(__file__).with_name("mrcal_worker.py"))],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )
        assert self._process.stdout is not None
        self.ready = '"ready"' in self._process.stdout.readline()

    def __enter__(self) -> Mrcal:
        return self

    def __exit__(self, *_: object) -> None:
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait(timeout=60)

    def time(self, camera: TimedCamera, task: str, values: Path, repeats: int, output: Path | None) -> dict:
        """Return the worker's answer: seconds a call, or why it refused."""
        request = {
            "task": task,
            "lens": camera.lens,
            "intrinsics": camera.intrinsics,
            "input": str(values),
            "repeats": repeats,
            "output": str(output) if output else None,
        }
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.write(json.dumps(request) + "\n")
        self._process.stdin.flush()
        return dict(json.loads(self._process.stdout.readline() or '{"refused": "mrcal ended"}'))


def time_calls(call: Callable[[], object], repeats: int) -> float:
    """Return seconds a call."""
    start = time.thread_time()
    for _ in range(repeats):
        call()
    return (time.thread_time() - start) / repeats


def bench_cameras(mrcal: Mrcal | None, folder: Path, rounds: int) -> list[GeometryRow]:
    """Time every camera, task and number of points, in turns with mrcal."""
    rng = np.random.default_rng(1)
    cameras = (
        bench_camera("CAHVOR", "CAHVOR", (0, 0, 0)),
        bench_camera("CAHVORE", "CAHVORE", (-0.0036, 0.013, -0.024)),
        bench_camera("CAHVORE, E = 0", "CAHVORE", (0, 0, 0)),
        *(opencv_camera(kind) for kind in KINDS),
    )
    rows = []
    for camera, task in itertools.product(cameras, ("forward", "gradient", "inverse")):
        per_point_s = 0.0  # mrcal's, from the smaller number of points
        for count in COUNTS:
            pixels = rng.uniform(0.0, 1.0, (count, 2)) * (np.array(camera.model.size_px) - 1.0)
            rays = camera.model.ray(pixels)
            points = rays.origins_m + rng.uniform(1.0, 50.0, (count, 1)) * rays.directions
            values = pixels if task == "inverse" else points
            theirs: Callable[[int], float] | None = None
            note = "no mrcal"
            if not camera.lens:
                note = "no such lens in mrcal"
            elif mrcal is not None and task == "inverse" and camera.model.E.any():
                note = "mrcal's needs E = 0"
            elif mrcal is not None and per_point_s * count > LONGEST_S:
                note = f"mrcal's would take {per_point_s * count:.0f} s"
            elif mrcal is not None:
                values_file, output_file = folder / "values.npy", folder / "output.npy"
                np.save(values_file, values)
                answer = mrcal.time(camera, task, values_file, 1, output_file)
                if "refused" in answer:
                    note = "mrcal's does not exist"
                else:
                    per_point_s = answer["seconds"] / count
                    gap = float(np.abs(np.load(output_file) - run(camera.model, task, values)).max())
                    note = f"agree to {gap:.0e}" if gap <= SAME[task] else f"DIFFER by {gap:.1e}"

                    def theirs(
                        repeats: int,
                        mrcal: Mrcal = mrcal,
                        camera: TimedCamera = camera,
                        task: str = task,
                        values_file: Path = values_file,
                    ) -> float:
                        return float(mrcal.time(camera, task, values_file, repeats, None)["seconds"])

            by_cv2: Callable[[int], float] | None = None
            if camera.name in KINDS:
                note += f", cv2 {_cv2_gap(camera.model, task, values):.0e}"

                def by_cv2(
                    repeats: int, m: CameraModel = camera.model, t: str = task, v: np.ndarray = values
                ) -> float:
                    return time_calls(lambda: run_cv2(m, t, v), repeats)

            own, other, third = in_turns(
                lambda repeats, m=camera.model, t=task, v=values: time_calls(lambda: run(m, t, v), repeats),
                theirs,
                by_cv2,
                rounds,
            )
            few = count == COUNTS[0] and camera.name != "CAHVORE, E = 0" and camera.name != "CAHVORE"
            beside = other or third
            rows.append(
                GeometryRow(
                    camera.name,
                    task,
                    count,
                    count / own / 1e6,
                    count / other / 1e6 if other else None,
                    count / third / 1e6 if third else None,
                    beside / own if beside else None,
                    WANTED_FEW[task] if few else WANTED.get((camera.name, task)),
                    note,
                )
            )
    return rows


def run(model: CameraModel, task: str, values: np.ndarray) -> np.ndarray:
    """Carry out one task here."""
    if task == "inverse":
        return model.ray(values).directions
    return model.project_jacobian(values)[1] if task == "gradient" else model.project(values)[0]


def _cv2_gap(model: CameraModel, task: str, values: np.ndarray) -> float:
    """How far cv2's result is from ours at most: pixels, or slopes of a ray."""
    found = run_cv2(model, task, values)
    ours = run(model, "forward" if task != "inverse" else task, values)
    if task == "inverse":
        ours = ours[:, :2] / ours[:, 2:]
    return float(np.abs(found.reshape(-1, 2) - ours).max())


def in_turns(
    ours: Callable[[int], float],
    theirs: Callable[[int], float] | None,
    thirds: Callable[[int], float] | None,
    rounds: int,
) -> tuple[float, float | None, float | None]:
    """Return the median seconds a call of all sides, timed in alternating rounds."""
    sides = [side for side in (ours, theirs, thirds) if side is not None]
    repeats = [max(1, min(1000, int(ROUND_S / side(1)))) for side in sides]
    times = [[side(n) for side, n in zip(sides, repeats, strict=True)] for _ in range(rounds)]
    medians = dict(
        zip(sides, (statistics.median(column) for column in zip(*times, strict=True)), strict=True)
    )
    return medians[ours], medians.get(theirs), medians.get(thirds)  # type: ignore[arg-type]  # None is no key


def numeric_pointing(
    mast: Mast,
    origin: np.ndarray,
    direction: np.ndarray,
    target_m: np.ndarray,
    start: np.ndarray,
    method: str,
) -> np.ndarray:
    """Return pan and tilt by SciPy, from the target's miss of the ray; the ray is given.

    Its residual is plain floats, so that what is timed is SciPy.
    """
    across = np.cross(direction, np.eye(3)[np.argmin(np.abs(direction))])
    across /= np.linalg.norm(across)
    (ax, ay, az), (bx, by, bz) = across.tolist(), np.cross(direction, across).tolist()
    cx, cy, cz = origin.tolist()
    px, py, pz = mast.rover_from_mast.inverse.points(target_m).tolist()
    a, sin_k, cos_k = mast.axis_offset_m, math.sin(mast.axis_twist_rad), math.cos(mast.axis_twist_rad)
    range_m = math.sqrt(px * px + py * py + pz * pz)

    def miss(joints: np.ndarray) -> list[float]:
        pan, tilt = joints.tolist()
        sin_p, cos_p, sin_t, cos_t = math.sin(pan), math.cos(pan), math.sin(tilt), math.cos(tilt)
        x, y = cos_p * px + sin_p * py - a, cos_p * py - sin_p * px
        y, z = cos_k * y + sin_k * pz, cos_k * pz - sin_k * y
        x, z = cos_t * x - sin_t * z - cx, sin_t * x + cos_t * z - cz
        y -= cy
        return [(ax * x + ay * y + az * z) / range_m, (bx * x + by * y + bz * z) / range_m]

    return np.asarray(least_squares(miss, start, method=method).x)


def bench_pointing(rounds: int, kinds: Sequence[str]) -> list[PointingRow]:
    """Time the closed form, its ray included, and least squares with the ray given, on the same targets."""
    head_from_camera = Rigid(np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]), np.array([0.06, -0.1, -0.05]))
    rows = []
    for kind, (name, offset_m, twist_rad) in itertools.product(
        kinds, (("a = 0", 0.0, 0.0), ("a = 0.05 m", 0.05, 0.02))
    ):
        plain = opencv_camera(kind) if kind in KINDS else bench_camera(kind, kind, (0, 0, 0))
        camera = plain.model.moved(head_from_camera)
        rng = np.random.default_rng(2)
        mast = Mast(
            np.array([0.3443, -0.0043, -1.4572]), np.array([-0.0088, -0.0181, 0.0027]), offset_m, twist_rad
        )
        cases = []
        for _ in range(POINTINGS):
            pixel = rng.uniform(0.0, 1.0, 2) * (np.array(camera.size_px) - 1.0)
            joints = np.array([rng.uniform(-2.5, 2.5), rng.uniform(-1.0, 0.5)])
            ray = camera.ray(pixel)
            point = ray.origins_m + rng.uniform(1.0, 50.0) * ray.directions
            pan, tilt = rot_z(joints[0]), rot_x(twist_rad) @ rot_y(joints[1])
            in_mast = pan @ (np.array([offset_m, 0.0, 0.0]) + tilt @ point)
            start = joints + 0.1 * rng.choice([-1.0, 1.0], 2) / math.sqrt(2.0)
            cases.append((pixel, joints, ray, mast.rover_from_mast.points(in_mast), start))

        def closed(mast: Mast = mast, cases: list = cases, camera: CameraModel = camera) -> list:
            return [solve(mast, camera, target, pixel) for pixel, _, _, target, _ in cases]

        def numeric(method: str, mast: Mast = mast, cases: list = cases) -> list:
            return [
                numeric_pointing(mast, ray.origins_m, ray.directions, target, start, method)
                for _, _, ray, target, start in cases
            ]

        for (_, joints, *_), solutions, found in zip(cases, closed(), numeric("trf"), strict=True):
            gaps = [max(abs(s.pan_rad - joints[0]), abs(s.tilt_rad - joints[1])) for s in solutions]
            # far off the axis of a wide lens, least squares may end at the other solution
            if min(gaps) > SAME_RAD or (kind not in KINDS and np.abs(found - joints).max() > SAME_RAD):
                sys.exit(f"pan and tilt {joints.tolist()} were not found again; nothing is timed")
        calls = (closed, lambda numeric=numeric: numeric("trf"), lambda numeric=numeric: numeric("lm"))
        times = [[time_calls(call, 1) for call in calls] for _ in range(rounds)]
        own, usual, quick = (statistics.median(t) / POINTINGS * 1e6 for t in zip(*times, strict=True))
        wanted_us = WANTED_POINTING_US[name]
        rows.append(PointingRow(f"{kind}, {name}", own, wanted_us, usual, usual / own, quick, quick / own))
    return rows


def print_tables(rows: list[GeometryRow], pointings: list[PointingRow], with_mrcal: bool) -> None:
    """Print both tables as text."""
    beside = "mrcal (Debian's or this interpreter's)" if with_mrcal else "no mrcal found: ratios are missing"
    print(f"Camera models, million points a second, one thread; {beside}")
    print(
        f"{'camera':15} {'task':9} {'points':>8} {'here':>7} {'mrcal':>7} {'cv2':>7} {'ratio':>6} "
        f"{'wanted':>6}"
    )
    for row in rows:
        rates = (row.mrcal_rate, row.cv2_rate, row.ratio, row.wanted)
        cells = [f"{v:.1f}" if v is not None else "-" for v in rates]
        print(
            f"{row.camera:15} {row.task:9} {row.points:8d} {row.rate:7.1f} {cells[0]:>7} {cells[1]:>7} "
            f"{cells[2]:>6} {cells[3]:>6}  {row.verdict:7}  {row.note}"
        )
    print("gradient: d pixel / d point; mrcal returns the gradient to its lens parameters with it")
    print()
    print(
        "One pointing solution, µs, its ray included; scipy's least_squares from 0.1 rad away, its ray given:"
    )
    print("by default (trf), which the wanted ratio is about, and by its quickest method (lm)")
    print(
        f"{'camera, mast':26} {'here':>7} {'wanted':>7} {'trf':>7} {'ratio':>6} {'wanted':>6} {'lm':>7} "
        f"{'ratio':>6}"
    )
    for p in pointings:
        print(
            f"{p.mast:26} {p.solve_us:7.1f} {p.wanted_us:7.0f} {p.least_squares_us:7.0f} {p.ratio:6.1f} "
            f"{WANTED_POINTING_RATIO:6.0f} {p.levenberg_us:7.0f} {p.levenberg_ratio:6.1f}  {p.verdict}"
        )


def find_mrcal(folder: Path) -> Mrcal | None:
    """Start mrcal in the first interpreter that has it."""
    for interpreter in (sys.executable, "/usr/bin/python3"):
        if Path(interpreter).exists():
            mrcal = Mrcal(interpreter, folder)
            if mrcal.ready:
                return mrcal
            mrcal.__exit__()
    return None


def main() -> int:
    """Run both benchmarks and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=at_least(1), default=7, help="how often each is timed (default 7)")
    parser.add_argument("--json", action="store_true", help="print one JSON document instead of tables")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        mrcal = find_mrcal(Path(name))
        if mrcal is None:
            rows = bench_cameras(None, Path(name), arguments.rounds)
        else:
            with mrcal:
                rows = bench_cameras(mrcal, Path(name), arguments.rounds)
    pointings = bench_pointing(arguments.rounds, ("CAHVOR", *KINDS))
    if arguments.json:
        document = {
            "cameras": [asdict(row) | {"verdict": row.verdict} for row in rows],
            "pointing": [asdict(row) | {"verdict": row.verdict} for row in pointings],
        }
        print(json.dumps(document, indent=1))
    else:
        print_tables(rows, pointings, mrcal is not None)
    return 0


if __name__ == "__main__":
    end(main)
