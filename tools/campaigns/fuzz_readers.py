"""Feed broken files to every reader and command.

    .venv/bin/python -m tools.campaigns.fuzz_readers --cases 100000 --seed 1

A case takes a valid file (or none), breaks it, and reads it. Allowed is a result or a refusal in one line
(`BadFile` from a reader; exit code 1 or 2 without code ``internal`` from a command) that changes no file.
Everything else is printed with the bytes that caused it, and the exit code is 1.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import random
import signal
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from calib.errors import BadFile
from calib.files import CameraFile
from calib.files.cahvor_text import format_cahvor, parse_cahvor
from calib.files.mast_file import StoredRig, parse_camera, parse_rig, save_camera
from calib.files.mrcal_kalibr_colmap import parse_colmap, parse_kalibr, parse_mrcal
from calib.files.odl import parse_label
from calib.files.opencv_ros import parse_camera_info, parse_opencv
from calib.files.pds3 import load_pds3_camera, read_product
from calib.files.tables import parse_table
from calib.geometry.cahvor import FREE
from calib.survey.check import check_survey
from calib.survey.reader import read_survey
from calib.targets.board_file import parse_board
from calib.targets.boards import AnyBoard
from calib.targets.pattern import pattern_of
from mastctl.cli.main import main as mastctl
from tools.command import end, options

HANG_S = 20

_CAMERA = b"""size_px: [641, 481]
model: CAHVORE
C: [0.1, -0.1, 0]
A: [1, 0, 0]
H: [320, 1000, 0]
V: [240, 0, 1e+3]
O: [1.0, 0.0, 0.0]
R: [0.0, -1e-3, 0.01]
E: [0.001, 0.0, 0.0]
type: 3
linearity: 0.37
"""
_MAST = (
    b"schema: mastctl/mast/1\nname: bench\n"
    b"mast: {translation_m: [1, 2, -3], rotation_rad: [0.1, 0, 0],\n"
    b"       axis_offset_m: 0.05, axis_twist_rad: 0.1}\n"
    b"cameras:\n  eye_left:\n    on: head\n    "
    + _CAMERA.replace(b"\n", b"\n    ").rstrip()
    + b"\n  eye_right: {on: head, size_px: [641, 481], model: CAHV, C: [0, 0.1, 0],\n"
    b"    A: [1, 0, 0], H: [320, 1000, 0], V: [240, 0, 1000]}\n"
    b"stereo: {eye: [eye_left, eye_right]}\nfit: {rms_px: 0.1, parameters: [a, b]}\nprovenance: {by: me}\n"
)
_CAHVOR = (
    b"# comment\nModel = CAHV = perspective, linear\nDimensions = 641 481\n"
    b"C = 0.0 0.1 0.0\nA = 1.0 0.0 0.0\nH = 320.0 1000.0 0.0\nV = 240.0 0.0 1000.0\nS =\n"
    + b"".join(b" ".join(b"1.0" if i == j else b"0.0" for j in range(12)) + b"\n" for i in range(12))
    + b"Hs    = 1000.0\nHc    = 320.0\nVs    = 1000.0\nVc    = 240.0\nTheta = -1.57 (-90.0 deg)\n"
    b"S internal =\n" + b"0 0 0 0 0\n" * 5
)
_LABEL = b"""PDS_VERSION_ID = PDS3
RECORD_BYTES = 64
^IMAGE = 20
PRODUCT_ID = "X  Y"
GROUP = PMA_ARTICULATION_STATE
  ARTICULATION_DEVICE_ANGLE = (-0.34 <rad>,-0.1 <rad>)
  ARTICULATION_DEVICE_ANGLE_NAME = ("AZIMUTH-MEASURED", "ELEVATION-MEASURED")
END_GROUP = PMA_ARTICULATION_STATE
OBJECT = IMAGE /* comment */
  LINES = 3
  LINE_SAMPLES = 4
  SAMPLE_TYPE = MSB_INTEGER
  SAMPLE_BITS = 16
  SAMPLE_BIT_MASK = 2#0000111111111111#
END_OBJECT = IMAGE
GROUP = GEOMETRIC_CAMERA_MODEL
  MODEL_TYPE = CAHVORE
  MODEL_COMPONENT_1 = (0.6,-0.04,-0.2)
  MODEL_COMPONENT_2 = (1.0,0.0,0.0)
  MODEL_COMPONENT_3 = (350.0,450.0,0.0)
  MODEL_COMPONENT_4 = (35.0,0.0,680.0)
  MODEL_COMPONENT_5 = (1.0,0.0,0.0)
  MODEL_COMPONENT_6 = (3e-06,-0.012,-0.0075)
  MODEL_COMPONENT_7 = (0.0014,0.0015,0.0004)
  MODEL_COMPONENT_8 = 2.0
  MODEL_COMPONENT_9 = 0.0
  REFERENCE_COORD_SYSTEM_NAME = ROVER_FRAME
END_GROUP = GEOMETRIC_CAMERA_MODEL
END
"""
_OPENCV = b"""%YAML:1.0
---
image_width: 64
image_height: 48
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 60., 0., 31.9, 0., 60.1, 24.1, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: [ -3.1e-01, 1.2e-01, 1.e-03, -7.e-04, 2.e-02 ]
"""
_INFO = b"""image_width: 64
image_height: 48
camera_name: left
camera_matrix: {rows: 3, cols: 3, data: [60, 0, 31.9, 0, 60.1, 24.1, 0, 0, 1]}
distortion_model: rational_polynomial
distortion_coefficients: {rows: 1, cols: 8, data: [0.4, 0.05, 0.001, -0.0007, 0.002, 0.75, 0.1, 0.005]}
rectification_matrix: {rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}
"""
_CHAIN = b"""cam0:
  camera_model: pinhole
  intrinsics: [46.1, 46.2, 36.7, 24.6]
  distortion_model: radtan
  distortion_coeffs: [-0.277, 0.067, 0.0009, 0.0001]
  resolution: [75, 48]
cam1:
  camera_model: pinhole
  intrinsics: [45.0, 45.5, 37.3, 25.3]
  distortion_model: equidistant
  distortion_coeffs: [-0.03, 0.012, -0.004, 0.0006]
  resolution: [75, 48]
  T_cn_cnm1:
  - [0, 0, 1, -0.11]
  - [0, 1, 0, 0.002]
  - [-1, 0, 0, 0.003]
  - [0, 0, 0, 1]
"""
_MRCAL = b"""# generated
{ 'lensmodel':  'LENSMODEL_CAHVORE_linearity=0.37',
  'intrinsics': [ 122.5, 122.25, 51.25, 38.5, 0.0087, -0.0042, 0.0, -0.11, 0.05, 0.01, 0.0, 0.0,],
  'extrinsics': [ 0.1, 0.2, -0.3, 1, 2, 3,],
  'imagersize': [ 102, 76,],
  'optimization_inputs': b'P)h>@6aWA{K2;]}#',
}
"""
_COLMAP = b"""# cameras
1 SIMPLE_RADIAL 64 48 60 32 24.5 -0.1
7 OPENCV_FISHEYE 64 48 60 60.1 32 24 -0.03 0.01 1e-3 0
"""

#: One valid file of each kind.
VALID: dict[str, bytes] = {
    "mast.yaml": _MAST,
    "camera.yaml": b"schema: mastctl/camera/1\nframe: bench\n" + _CAMERA,
    "camera.cahvor": _CAHVOR,
    "product.img": _LABEL.ljust(19 * 64) + bytes(range(24)),
    "camera.opencv.yaml": _OPENCV,
    "camera.ros.yaml": _INFO,
    "chain.kalibr.yaml": _CHAIN,
    "camera.cameramodel": _MRCAL,
    "cameras.txt": _COLMAP,
    "points.csv": b"x_m,y_m,z_m\n10,1,-2\n-1,0,0\nnan,0,0\n,,\n1e300,-1e-300,0\n",
    "pixels.csv": b"x_px,y_px\n320,240\n-1e9,0\ninf,0\n",
}

_BOARD = b"""schema: mastctl/board/1
name: bench
kind: charuco
columns: 9
rows: 12
square_m: 0.02
marker_m: 0.015
dictionary: DICT_5X5_100
first_id: 3
legacy: false
aspect: 1.001
bar_m: {across: 0.15, down: 0.2}
measured: {across_m: 0.1496, down_m: 0.1998}
"""
VALID["board.yaml"] = _BOARD
_BENCH = {
    "survey.yaml": b"""schema: mastctl/survey/1
boards:
  wall: {kind: aprilgrid, columns: 6, rows: 4, tag_m: 0.03, gap_m: 0.009, border: 2}
  desk: {kind: dots, columns: 4, rows: 3, spacing_m: 0.02, dot_diameter_m: 0.01}
sigma: {corner_px: 0.1, joint_rad: 0.0002}
cameras:
  eye_left: {on: head, size_px: [1024, 768], model: CAHVOR, focal_px: 1290}
  low_left: {on: rover, size_px: [640, 480], model: CAHVORE, focal_px: 309}
""",
    "images.csv": b"""image,camera,placement,board,purpose,pan_rad,tilt_rad,pan_approach,tilt_approach,file
one,eye_left,near,wall,camera,0.0,-0.17,1,-1,
two,low_left,near,desk,camera,,,,,
""",
    "corners.csv": b"image,board,id,x_px,y_px,sigma_px\none,wall,0,4.5,3.25,0.02\ntwo,desk,11,100,200,\n",
}
VALID |= {f"bench_{name}": data for name, data in _BENCH.items()}

_NASTY = [
    *b"nan -inf .inf 1e400 -1e308 5e-324 0 -0.0 ~ true '1' *a ? # \" ' = ^ : /* */".split(),
    *b"[ ] { } [[[[ , ; ( ) < >".split(),
    *b"<rad> END_GROUP 2#1# 37#1# CAHV CAHVOR CAHVORE3,1 1_0 0x1 --- ... <<: END GROUP".split(),
    *(
        b"9" * 500,
        b"",
        b"&a ",
        b"!!set ",
        b"!!python/object:os.system ",
        b"- ",
        b": ",
        b"---\n",
        b"\n",
        b"\r",
        b"\t",
    ),
    *(
        b"\0",
        b"\xff",
        b"\xef\xbb\xbf",
        b"\xc2\x85",
        b"\xe2\x80\xa8",
        "\u0663".encode(),
        b"END\n",
        b"GROUP = A\n",
    ),
    *(b"S =\n", b"1 2 3 4", b"schema: mastctl/mast/1\n"),
]


def broken(rng: random.Random, data: bytes) -> bytes:
    """Return the bytes after one to eight random edits, or random bytes instead."""
    if rng.random() < 0.03:
        return rng.randbytes(rng.randrange(400))
    out = bytearray(data)
    for _ in range(rng.choice((1, 1, 1, 2, 3, 8))):
        at = rng.randrange(len(out) + 1)
        to = min(len(out), at + rng.choice((1, 1, 2, 5, 20, 100)))
        match rng.randrange(8):
            case 0:
                out[at:to] = rng.randbytes(to - at)
            case 1:
                del out[at:to]
            case 2:
                out[at:at] = rng.choice(_NASTY)
            case 3:
                out[at:to] = rng.choice(_NASTY)
            case 4:
                out[at:at] = out[at:to] * rng.choice((1, 2, 50))
            case 5:
                out[at:] = b""
            case 6:
                _replace_word(rng, out)
            case _:
                lines = out.split(b"\n")
                i, j = rng.randrange(len(lines)), rng.randrange(len(lines))
                lines[i], lines[j] = lines[j], lines[i]
                out = bytearray(b"\n".join(lines))
    return bytes(out)


def _replace_word(rng: random.Random, out: bytearray) -> None:
    """Put a nasty word, another word of the file or a random number in the place of a word."""
    words = [word.strip(b",[]{}():") for word in out.split()]
    words = [word for word in words if word]
    if words:
        old = rng.choice(words)
        at = out.find(old, rng.randrange(len(out)))
        number = repr(rng.uniform(-1, 1) * 10.0 ** rng.randint(-12, 12)).encode()
        if at >= 0:
            out[at : at + len(old)] = rng.choice((rng.choice(_NASTY), rng.choice(words), number))


def _use_model(camera: CameraFile) -> None:
    """What a caller does with a camera that was read: it must not fail later instead."""
    points = camera.model.C + np.array([[5.0, 0.1, 0.2], [-5.0, 0.0, 0.0], [0.0, 0.0, 0.0], [np.nan, 0, 0]])
    camera.model.project(points)
    camera.model.ray(np.array([[0.0, 0.0], [320.0, 240.0], [1e9, np.inf]]))
    if not np.isfinite(camera.model.C).all():
        raise AssertionError("a camera that is not finite was accepted")
    if camera.model.kind in FREE:
        with tempfile.TemporaryDirectory() as folder:
            save_camera(camera, Path(folder) / "camera.yaml")
    else:
        format_cahvor(camera)


def _use_rig(stored: StoredRig) -> None:
    for name in stored.rig.cameras:
        _use_model(CameraFile(stored.rig.camera_in_rover(name, 0.3, -0.2), "rover"))


def _use_all(cameras: Mapping[str, CameraFile]) -> None:
    for camera in cameras.values():
        _use_model(camera)


def _product(data: bytes, path: str) -> None:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / path
        file.write_bytes(data)
        read_product(file)
        _use_model(load_pds3_camera(file))


def _use_board(board: AnyBoard) -> None:
    if not np.isfinite(board.in_board_m(board.ids, (0.001, -0.001))).all() or min(board.size_m) <= 0.0:
        raise AssertionError("a board without a size was accepted")
    pattern_of(board)


def _use_bench(data: bytes, broken_file: str) -> None:
    with tempfile.TemporaryDirectory() as folder:
        for name, valid in _BENCH.items():
            (Path(folder) / name).write_bytes(data if name == broken_file else valid)
        survey = read_survey(folder)
        check_survey(survey)
        for image in survey.images:
            if image.name in survey.corners:
                survey.boards[image.board].in_board_m(survey.corners[image.name].ids)


#: Reader name to the valid file that it reads and the reading.
READERS: dict[str, tuple[str, Callable[[bytes], Any]]] = {
    "mast": ("mast.yaml", lambda data: _use_rig(parse_rig(data, "f"))),
    "camera": ("camera.yaml", lambda data: _use_model(parse_camera(data, "f"))),
    "cahvor": ("camera.cahvor", lambda data: _use_model(parse_cahvor(data, "f"))),
    "label": ("product.img", lambda data: parse_label(data.decode("latin-1"), "f")),
    "product": ("product.img", lambda data: _product(data, "product.img")),
    "opencv": ("camera.opencv.yaml", lambda data: _use_model(parse_opencv(data, "f"))),
    "ros": ("camera.ros.yaml", lambda data: _use_model(parse_camera_info(data, "f"))),
    "kalibr": ("chain.kalibr.yaml", lambda data: _use_all(parse_kalibr(data, "f"))),
    "mrcal": ("camera.cameramodel", lambda data: _use_model(parse_mrcal(data, "f"))),
    "colmap": ("cameras.txt", lambda data: _use_all(parse_colmap(data, "f"))),
    "board": ("board.yaml", lambda data: _use_board(parse_board(data, "f"))),
    "bench": ("bench_survey.yaml", lambda data: _use_bench(data, "survey.yaml")),
    "bench images": ("bench_images.csv", lambda data: _use_bench(data, "images.csv")),
    "bench corners": ("bench_corners.csv", lambda data: _use_bench(data, "corners.csv")),
    "points": ("points.csv", lambda data: parse_table(data, "f", ("x_m", "y_m", "z_m"))),
    "pixels": ("pixels.csv", lambda data: parse_table(data, "f", ("x_px", "y_px"))),
}

#: The command line, and the file of it that is broken.
COMMANDS: list[tuple[str, str]] = [
    ("camera project mast.yaml --camera eye_left --pan 0.1 --tilt -0.2 --points points.csv", "mast.yaml"),
    ("camera project camera.yaml --points points.csv", "camera.yaml"),
    ("camera project camera.yaml --points points.csv", "points.csv"),
    ("camera ray camera.yaml --pixels pixels.csv", "pixels.csv"),
    ("camera ray camera.cahvor --pixels pixels.csv", "camera.cahvor"),
    ("camera convert product.img out.yaml", "product.img"),
    ("camera convert camera.cahvor out.cahvor", "camera.cahvor"),
    ("camera convert mast.yaml out.cahvor --camera eye_right", "mast.yaml"),
    ("camera convert camera.opencv.yaml out.ros.yaml", "camera.opencv.yaml"),
    ("camera convert camera.ros.yaml out.cameramodel --limit-px 5", "camera.ros.yaml"),
    ("camera convert chain.kalibr.yaml out.yaml --camera cam1", "chain.kalibr.yaml"),
    ("camera convert camera.cameramodel out.kalibr.yaml --limit-px 9", "camera.cameramodel"),
    ("camera convert cameras.txt out.opencv.yaml --camera 7", "cameras.txt"),
    ("solve mast.yaml --camera eye_left --target 5 -1 0.5", "mast.yaml"),
    ("triangulate mast.yaml --pair eye --pan 0 --tilt 0 --left 300 240 --right 280 240", "mast.yaml"),
]


def check_reader(name: str, data: bytes) -> str:
    """Read the bytes; return 'read' or 'refused', or raise AssertionError or what the reader let out."""
    try:
        READERS[name][1](data)
    except BadFile as refusal:
        message = str(refusal)
        if "\n" in message or len(message) > 700:
            raise AssertionError(f"a refusal that is not one line: {message[:1000]!r}") from None
        return "refused"
    return "read"


def check_command(words: str, file: str, data: bytes, folder: Path) -> str:
    """Run the command in ``folder`` with ``file`` holding ``data``; return 'done', 'refused' or 'failed'."""
    for name, valid in VALID.items():
        (folder / name).write_bytes(data if name == file else valid)
    for out in folder.glob("out*"):
        out.unlink()
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    stdout = io.StringIO()
    with (
        open(os.devnull, "w") as stderr,  # noqa: PTH123  a real file: the log goes to its descriptor
        contextlib.chdir(folder),
        contextlib.redirect_stdout(stdout),
        contextlib.redirect_stderr(stderr),
    ):
        code = mastctl([*words.split(), "--json"])
    after = {path.name: path.read_bytes() for path in folder.iterdir()}
    if code == 0:
        return "done"
    if code not in (1, 2):
        raise AssertionError(f"exit code {code}")
    error = json.loads(stdout.getvalue())["error"]
    if error["code"] == "internal" or not error["message"]:
        raise AssertionError(f"a defect was told: {error}")
    if before != after:
        raise AssertionError(f"a refused command changed files: {sorted(set(before) ^ set(after))}")
    return "refused" if code == 2 else "failed"


class _Hang(Exception):
    pass


@contextlib.contextmanager
def _alarm() -> Iterator[None]:
    def hang(*_: object) -> None:
        raise _Hang(f"no answer within {HANG_S} s")

    signal.signal(signal.SIGALRM, hang)
    signal.alarm(HANG_S)
    try:
        yield
    finally:
        signal.alarm(0)


def main() -> int:
    """Run the campaign, print counts and the slowest case, and return 1 if anything was let out."""
    parser = options(__doc__, 20_000, tasks=False)
    parser.add_argument(
        "--command-share", type=float, default=0.2, help="part of the cases that run a command"
    )
    args = parser.parse_args()
    counts: Counter[tuple[str, str]] = Counter()
    slowest: dict[str, float] = {}
    bad = 0
    started = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder, np.errstate(all="ignore"):
        for case in range(args.cases):
            rng = random.Random(f"{args.seed}/{case}")
            if rng.random() < args.command_share:
                words, file = rng.choice(COMMANDS)
                what = "mastctl " + " ".join(words.split()[: 2 if words.startswith("camera") else 1])
                data = broken(rng, VALID[file])
                run = partial(check_command, words, file, data, Path(folder))
            else:
                what = rng.choice(list(READERS))
                data = broken(rng, VALID[READERS[what][0]])
                run = partial(check_reader, what, data)
            begun = time.perf_counter()
            try:
                with _alarm():
                    counts[what, run()] += 1
            except Exception as error:
                bad += 1
                print(f"seed {args.seed} case {case}: {what}: {type(error).__name__}: {error}\n  {data!r}")
            slowest[what] = max(slowest.get(what, 0.0), time.perf_counter() - begun)
    spent_s = time.perf_counter() - started
    print(f"{args.cases} cases, seed {args.seed}, {spent_s:.0f} s, {bad} let something out")
    for what in sorted(slowest):
        told = {outcome: n for (name, outcome), n in sorted(counts.items()) if name == what}
        print(f"  {what:24s} slowest {1e3 * slowest[what]:7.1f} ms  {told}")
    return 1 if bad else 0


if __name__ == "__main__":
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    end(main)
