"""Valid files of every kind, ways to break them, and what a reader or a command may do with a broken one.

Allowed is a result or a refusal in one line (`BadFile` from a reader; exit code 1 or 2 without code
``internal`` from a command) that changes no file.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import random
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from calib.errors import BadFile
from calib.files import CameraFile
from calib.files.cahvor_text import format_cahvor, parse_cahvor
from calib.files.mast_file import StoredRig, parse_camera, parse_rig, save_camera
from calib.files.mrcal_kalibr import parse_kalibr, parse_mrcal
from calib.files.opencv_ros import parse_calibration
from calib.files.tables import parse_table
from calib.geometry.cahvor import FREE
from calib.survey.check import check_survey
from calib.survey.reader import read_survey
from calib.targets.board_file import parse_board
from calib.targets.boards import AnyBoard
from calib.targets.pattern import pattern_of
from drivers.recordings.pds3 import parse_label, read_product
from hil_tests.calib.files.test_other_formats import CHAIN, INFO, MODEL, OPENCV
from hil_tests.calib.survey.survey_case import FILES
from hil_tests.calib.survey.test_bench import CORNERS, IMAGES, YAML
from hil_tests.calib.targets.test_board_file import TEXT
from hil_tests.drivers.test_pds3 import LABEL
from mastctl.cli.main import main as mastctl

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


def _xml() -> bytes:
    """A camera as OpenCV writes it in XML."""
    store = cv2.FileStorage("camera.xml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    store.write("image_width", 64)
    store.write("image_height", 48)
    store.write("camera_matrix", np.array([[60.0, 0.0, 31.9], [0.0, 60.1, 24.1], [0.0, 0.0, 1.0]]))
    store.write("distortion_coefficients", np.array([[-0.31, 0.12, 0.001, -7e-4, 0.02]]))
    return store.releaseAndGetString().encode()


#: One valid file of each kind.
VALID: dict[str, bytes] = {
    "mast.yaml": _MAST,
    "camera.yaml": b"schema: mastctl/camera/1\nframe: bench\n" + _CAMERA,
    "camera.cahvor": _CAHVOR,
    "product.img": LABEL.encode().ljust(4096) + bytes(range(24)),
    "camera.opencv.yaml": OPENCV.encode(),
    "camera.xml": _xml(),
    "camera.ros.yaml": INFO.encode(),
    "chain.kalibr.yaml": CHAIN.encode(),
    "camera.cameramodel": MODEL.encode(),
    "board.yaml": TEXT.encode(),
    "points.csv": b"x_m,y_m,z_m\n10,1,-2\n-1,0,0\nnan,0,0\n,,\n1e300,-1e-300,0\n",
    "pixels.csv": b"x_px,y_px\n320,240\n-1e9,0\ninf,0\n",
}
_BENCH = {"survey.yaml": YAML.encode(), "images.csv": IMAGES.encode(), "corners.csv": CORNERS.encode()}
_STATION = {name: text.encode() for name, text in FILES.items()}
for _kind, _files in (("bench", _BENCH), ("station", _STATION)):
    VALID |= {f"{_kind}_{name}": data for name, data in _files.items()}

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
        format_cahvor(camera.model)


def _use_rig(stored: StoredRig) -> None:
    for name in stored.rig.cameras:
        _use_model(CameraFile(stored.rig.camera_in_rover(name, 0.3, -0.2), "rover"))


def _use_all(cameras: Mapping[str, CameraFile]) -> None:
    for one in cameras.values():
        _use_model(one)


def _product(data: bytes, path: str) -> None:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / path
        file.write_bytes(data)
        product = read_product(file)
        if product.camera_model is not None:
            _use_model(CameraFile(product.camera_model, product.frame))


def _use_board(board: AnyBoard) -> None:
    if not np.isfinite(board.in_board_m(board.ids, (0.001, -0.001))).all() or min(board.size_m) <= 0.0:
        raise AssertionError("a board without a size was accepted")
    pattern_of(board)


def _use_survey(data: bytes, broken_file: str, files: Mapping[str, bytes]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        for name, valid in files.items():
            (Path(folder) / name).write_bytes(data if name == broken_file else valid)
        survey = read_survey(folder)
        check_survey(survey)
        for image in survey.images:
            if image.name in survey.corners:
                survey.boards[image.board].in_board_m(survey.corners[image.name].ids)
            if image.name in survey.dots and not np.isfinite(survey.dots[image.name].pixels_px).all():
                raise AssertionError("a dot that is nowhere was accepted")


#: Reader name to the valid file that it reads and the reading.
READERS: dict[str, tuple[str, Callable[[bytes], Any]]] = {
    "mast": ("mast.yaml", lambda data: _use_rig(parse_rig(data, "f"))),
    "camera": ("camera.yaml", lambda data: _use_model(parse_camera(data, "f"))),
    "cahvor": ("camera.cahvor", lambda data: _use_model(parse_cahvor(data, "f"))),
    "label": ("product.img", lambda data: parse_label(data.decode("latin-1"), "f")),
    "product": ("product.img", lambda data: _product(data, "product.img")),
    "opencv": ("camera.opencv.yaml", lambda data: _use_model(parse_calibration(data, "f"))),
    "opencv xml": ("camera.xml", lambda data: _use_model(parse_calibration(data, "f"))),
    "ros": ("camera.ros.yaml", lambda data: _use_model(parse_calibration(data, "f"))),
    "kalibr": ("chain.kalibr.yaml", lambda data: _use_all(parse_kalibr(data, "f"))),
    "mrcal": ("camera.cameramodel", lambda data: _use_model(parse_mrcal(data, "f"))),
    "board": ("board.yaml", lambda data: _use_board(parse_board(data, "f"))),
    "bench": ("bench_survey.yaml", lambda data: _use_survey(data, "survey.yaml", _BENCH)),
    "bench images": ("bench_images.csv", lambda data: _use_survey(data, "images.csv", _BENCH)),
    "bench corners": ("bench_corners.csv", lambda data: _use_survey(data, "corners.csv", _BENCH)),
    "survey": ("station_survey.yaml", lambda data: _use_survey(data, "survey.yaml", _STATION)),
    "station": ("station_station.csv", lambda data: _use_survey(data, "station.csv", _STATION)),
    "dots": ("station_dots.csv", lambda data: _use_survey(data, "dots.csv", _STATION)),
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
    ("camera convert camera.cahvor out.cahvor", "camera.cahvor"),
    ("camera convert mast.yaml out.cahvor --camera eye_right", "mast.yaml"),
    ("camera convert camera.opencv.yaml out.ros.yaml", "camera.opencv.yaml"),
    ("camera convert camera.ros.yaml out.cameramodel --limit-px 5", "camera.ros.yaml"),
    ("camera convert chain.kalibr.yaml out.yaml --camera cam1", "chain.kalibr.yaml"),
    ("camera convert camera.cameramodel out.kalibr.yaml --limit-px 9", "camera.cameramodel"),
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
