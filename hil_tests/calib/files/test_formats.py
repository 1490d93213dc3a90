""".cahvor text, tables, telling formats apart; truth from JPL's way of reading, mrcal, files by hand."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calib.errors import BadFile
from calib.files import CameraFile
from calib.files import mast_file as store
from calib.files.any_camera import load_any, save_any
from calib.files.cahvor_text import (
    format_cahvor,
    internal_parameters,
    parse_cahvor,
)
from calib.files.tables import parse_table, read_table, write_table
from calib.geometry.cahvor import CameraModel
from hil_tests.calib.files.test_store import CAMERA_TEXT, MAST_TEXT

# As JPL's library writes it: nine decimals, blank lines, a comment, all derived values.
JPL_TEXT = """\
# Written from a test

Model = CAHVOR = perspective, distortion

Dimensions = 1024 768

C =      0.100000000     -0.200000000     -1.500000000
A =      1.000000000      0.000000000      0.000000000
H =    511.500000000   1290.000000000      0.000000000
V =    383.500000000      0.000000000   1290.000000000
O =      1.000000000      0.000000000      0.000000000
R =      0.000000000     -0.050000000      0.010000000

S =
{covariance}

Hs    =   1290.000000000
Hc    =    511.500000000
Vs    =   1290.000000000
Vc    =    383.500000000
Theta =     -1.570796327 (-90.000000 deg)

S internal =
{internal}

"""


def _jpl_text(covariance: np.ndarray | None = None) -> str:
    matrix = np.zeros((18, 18)) if covariance is None else covariance
    rows = "\n".join("".join(f" {value:16.9e}" for value in row) for row in matrix)
    return JPL_TEXT.format(covariance=rows, internal="\n".join([f" {0.0:16.9e}" * 5] * 5))


# As mrcal writes it: size first, ten decimals, no covariance in older versions, a comment before Theta.
MRCAL_TEXT = """\
# generated on a day
Dimensions = 1024 768
Model = CAHVORE3,0.37 = general
C =    0.1000000000   -0.2000000000   -1.5000000000
A =    1.0000000000    0.0000000000    0.0000000000
H =  511.5000000000 1290.0000000000    0.0000000000
V =  383.5000000000    0.0000000000 1290.0000000000
O =    1.0000000000    0.0000000000    0.0000000000
R =    0.0000000000   -0.0500000000    0.0100000000
E =    0.0010000000    0.0000000000    0.0000000000
VALID_INTRINSICS_REGION = 0.00 0.00 1023.00 0.00 1023.00 767.00 0.00 0.00
Hs = 1290.0
Hc = 511.5
Vs = 1290.0
Vc = 383.5
# this is hard-coded
Theta = -1.5707963267948966 (-90.0 deg)
"""


def test_a_file_of_jpls_writer_is_read() -> None:
    camera = parse_cahvor(_jpl_text().replace("\n", "\r\n").encode(), "x.cahvor")
    model = camera.model
    assert (model.kind, model.size_px, camera.frame) == ("CAHVOR", (1024, 768), "unknown")
    assert model.C.tolist() == [0.1, -0.2, -1.5]
    assert model.H.tolist() == [511.5, 1290.0, 0.0]
    assert model.R.tolist() == [0.0, -0.05, 0.01]
    assert camera.notes == ()
    assert not camera.fit


def test_a_file_of_mrcals_writer_is_read_and_what_is_not_read_is_said() -> None:
    camera = parse_cahvor(MRCAL_TEXT.encode(), "x.cahvor")
    model = camera.model
    assert (model.kind, model.cahvore_type, model.linearity) == ("CAHVORE", 3, 0.37)
    assert model.E.tolist() == [0.001, 0.0, 0.0]
    assert camera.notes == ("line 11, 'VALID_INTRINSICS_REGION =', is not read",)


@pytest.mark.parametrize(
    ("model", "kind", "cahvore_type", "linearity"),
    [
        ("CAHVORE1 = perspective, distortion, pupil", "CAHVORE", 1, 1.0),
        ("CAHVORE2 = fish-eye", "CAHVORE", 2, 0.0),
        ("CAHVORE3,-0.25 = general", "CAHVORE", 3, -0.25),
        ("CAHVORE3,1e-05 = general", "CAHVORE", 3, 1e-5),
        ("CAHVORE3 , .5", "CAHVORE", 3, 0.5),
    ],
)
def test_the_three_types_of_cahvore_are_distinguished(
    model: str, kind: str, cahvore_type: int, linearity: float
) -> None:
    text = MRCAL_TEXT.replace("CAHVORE3,0.37 = general", model)
    found = parse_cahvor(text.encode(), "x").model
    assert (found.kind, found.cahvore_type, found.linearity) == (kind, cahvore_type, linearity)


def test_a_cahv_file_needs_no_lens() -> None:
    lines = [line for line in JPL_TEXT.splitlines()[:10] if not line.startswith("Model")]
    assert parse_cahvor("\n".join(lines).encode(), "x").model.kind == "CAHV"


def test_what_the_text_cannot_hold_is_said(tmp_path: Path) -> None:
    model = parse_cahvor(_jpl_text().encode(), "x").model
    done = save_any(CameraFile(model, "rover", {"rms_px": 0.1}, {"by": "me"}), tmp_path / "a.cahvor")
    for part, sentence in zip(("frame", "fit", "provenance"), done.lost, strict=True):
        assert part in sentence
    assert save_any(CameraFile(model, "unknown"), tmp_path / "a.cahvor").lost == ()
    camera = parse_cahvor(_jpl_text(np.eye(18)).encode(), "x")
    assert camera.notes == ("line 14, 'S =', is not read",)


class _JplScanner:
    """Reads as JPL's C does: look for a string from here on, then take numbers after it."""

    def __init__(self, text: str) -> None:
        self.text, self.at = text, 0

    def scan(self, key: str) -> None:
        found = self.text.find(key, self.at)
        assert found >= 0, f"JPL's reader would not find '{key}'"
        self.at = found + len(key)

    def numbers(self, count: int) -> list[float]:
        numbers = self.text[self.at :].split()[:count]
        return [float(word) for word in numbers]


def _vector_models(reference_data: Path) -> list[tuple[str, dict[str, Any]]]:
    files = sorted((reference_data / "cahvor_vectors").glob("vectors_*.json"))
    return [(file.stem, json.loads(file.read_text())["model"]) for file in files]


def _model_of(numbers: dict[str, Any]) -> CameraModel:
    kind = numbers["model_type"]
    extra = {}
    if kind == "CAHVORE":
        extra = {"E": numbers["E"], "cahvore_type": int(numbers["T"]), "linearity": float(numbers["P"])}
    vectors = [numbers[letter] for letter in "CAHVOR"]
    return CameraModel(kind, (numbers["width"], numbers["height"]), *vectors, **extra)


def test_flown_cameras_go_through_every_format_unchanged(reference_data: Path, tmp_path: Path) -> None:
    names = []
    for name, numbers in _vector_models(reference_data):
        model = _model_of(numbers)
        names.append(name)
        for suffix in (".cahvor", ".yaml"):
            path = tmp_path / f"{name}{suffix}"
            save_any(CameraFile(model, "bench"), path)
            again = load_any(path)
            assert isinstance(again, CameraFile)
            assert (again.model.kind, again.model.size_px) == (model.kind, model.size_px)
            assert (again.model.cahvore_type, again.model.linearity) == (model.cahvore_type, model.linearity)
            for letter in "CAHVORE":
                np.testing.assert_array_equal(
                    getattr(again.model, letter), getattr(model, letter), err_msg=f"{name} {suffix} {letter}"
                )
    assert len(names) == 20


def test_jpls_reader_finds_every_value_in_what_is_written(reference_data: Path) -> None:
    for name, numbers in _vector_models(reference_data):
        model = _model_of(numbers)
        text = format_cahvor(model).decode()
        scanner = _JplScanner(text)
        if model.kind == "CAHVORE":
            scanner.scan("Model =")
            kind_word = text[scanner.at :].split()[0].split(",")[0]
            assert kind_word == f"CAHVORE{model.cahvore_type}"
        scanner.scan("Dimensions =")
        assert scanner.numbers(2) == list(model.size_px)
        for letter in model.kind:
            scanner.scan(f"{letter} =")
            assert scanner.numbers(3) == getattr(model, letter).tolist(), f"{name} {letter}"
        scanner.scan("S =")
        size = {"CAHV": 12, "CAHVOR": 18, "CAHVORE": 21}[model.kind]
        assert scanner.numbers(size * size) == [0.0] * (size * size)
        for key in ("Hs    =", "Hc    =", "Vs    =", "Vc    =", "Theta ="):
            scanner.scan(key)
            assert len(scanner.numbers(1)) == 1
        scanner.scan("S internal =")
        assert scanner.numbers(25) == [0.0] * 25


def test_the_derived_values_are_those_of_a_camera_made_from_them() -> None:
    # fx = 1200, cx = 500, fy = 1100, cy = 400, V leaning by 0.01 rad from the right angle.
    lean = 0.01
    across = np.array([0.0, 1.0, 0.0])
    down = np.array([0.0, -np.sin(lean), np.cos(lean)])
    axis = np.array([1.0, 0.0, 0.0])
    model = CameraModel(
        "CAHV", (1000, 800), np.zeros(3), axis, 1200 * across + 500 * axis, 1100 * down + 400 * axis
    )
    found = internal_parameters(model)
    assert found["Hs"] == pytest.approx(1200, abs=1e-9)
    assert found["Hc"] == pytest.approx(500, abs=1e-9)
    assert found["Vs"] == pytest.approx(1100, abs=1e-9)
    assert found["Vc"] == pytest.approx(400, abs=1e-9)
    assert abs(found["Theta"]) == pytest.approx(np.pi / 2 + lean, abs=1e-12)


BAD_CAHVOR = {
    "no model": ("Model = CAHVOR = perspective, distortion\n", "Model = FISHEYE\n", "line 3", "CAHVORE3"),
    "type 4": ("Model = CAHVOR = perspective, distortion\n", "Model = CAHVORE4\n", "line 3", "CAHVORE3"),
    "type 3 alone": (
        "Model = CAHVOR = perspective, distortion\n",
        "Model = CAHVORE3\n",
        "line 3",
        "linearity",
    ),
    "no size": ("Dimensions = 1024 768\n", "", "Dimensions", "missing"),
    "odd size": ("1024 768", "1024.5 768", "Dimensions", "width and height"),
    "one size": ("1024 768", "1024", "line 5", "2 are expected"),
    "no C": ("C = ", "# C = ", "C", "missing"),
    "two numbers": ("-0.200000000     -1.5", "-0.200000000 # -1.5", "line 7", "4 numbers"),
    "a word": ("-0.200000000", "left", "line 7", "'left'"),
    "nan": ("-0.200000000", "nan", "line 7", "'nan'"),
    "twice": ("O = ", "A = ", "line 11", "second 'A ='"),
    "A zero": ("A =      1.0", "A =      0.0", "A", "unit vector"),
    "flat": ("0.000000000   1290.000000000\nO", "0.0 0.0\nO", "", "one plane"),
    "E in CAHVOR": ("\nS =", "\nE = 0.1 0 0\nS =", "E", "CAHVOR has no E"),
    "OpenCV": ("\nS =", "\nLENSMODEL_OPENCV4 = 1 2 3 4\nS =", "line 14", "no other lens"),
    "stray": ("\nS =", "\nhello\nS =", "line 14", "KEY = value"),
    "short S": ("S =\n 0.000000000e+00", "S =\n 0.0 x", "line 15", "'x'"),
}


@pytest.mark.parametrize("case", BAD_CAHVOR)
def test_a_malformed_cahvor_file_is_refused_with_line_and_reason(case: str) -> None:
    old, new, place, phrase = BAD_CAHVOR[case]
    text = _jpl_text()
    if case == "short S":
        text = text.replace("S =\n  0", "S =\n 0")
    assert old in text
    with pytest.raises(BadFile) as refused:
        parse_cahvor(text.replace(old, new, 1).encode(), "x.cahvor")
    assert refused.value.place == place
    assert phrase in refused.value.reason
    assert "\n" not in str(refused.value)


def test_formats_are_known_by_content_whatever_the_name(tmp_path: Path) -> None:
    for name, data, expected in (
        ("a.txt", MAST_TEXT.encode(), "rig"),
        ("b.dat", CAMERA_TEXT.encode(), "CAHV"),
        ("c.cahv", _jpl_text().encode(), "CAHVOR"),
        ("e.cahvor", CAMERA_TEXT.encode(), "CAHV"),
    ):
        path = tmp_path / name
        path.write_bytes(data)
        found = load_any(path)
        kind = found.model.kind if isinstance(found, CameraFile) else "rig"
        assert kind == expected, name


@pytest.mark.parametrize(
    ("name", "data", "phrase"),
    [
        ("a.txt", b"hello", "is not one of these formats: a mast file, a camera file"),
        ("a.yaml", b"schema: mastctl/survey/1\n", "schema"),
        ("a.cahvor", b"hello", "KEY = value"),
        ("a.bin", bytes(range(256)), "is not one of these formats: a mast file"),
    ],
)
def test_a_file_of_no_known_format_is_refused(tmp_path: Path, name: str, data: bytes, phrase: str) -> None:
    (tmp_path / name).write_bytes(data)
    with pytest.raises(BadFile, match=phrase):
        load_any(tmp_path / name)


def test_saving_by_another_suffix_is_refused(tmp_path: Path) -> None:
    camera = store.parse_camera(CAMERA_TEXT.encode(), "x")
    with pytest.raises(BadFile, match=r"suffix '\.lbl' where \.cahvor"):
        save_any(camera, tmp_path / "a.lbl")
    assert not list(tmp_path.iterdir())


COLUMNS = ("x_m", "y_m", "z_m")


@pytest.mark.parametrize(
    "text",
    [
        b"x_m,y_m,z_m\n1,2,3\n-4e-3,.5,6.\n",
        b"\xef\xbb\xbfx_m,y_m,z_m\r\n1,2,3\r\n-4e-3,.5,6.\r\n",
        b"x_m, y_m, z_m\n 1, 2 ,3\n-4e-3,.5,6.",
        b'"x_m","y_m","z_m"\r1,2,3\r"-4e-3",.5,6.\r\r',
    ],
    ids=["plain", "byte-order mark, CRLF", "blanks, no last line end", "quotes, CR, blank end"],
)
def test_a_table_is_read_however_it_was_saved(text: bytes) -> None:
    assert parse_table(text, "p.csv", COLUMNS).tolist() == [[1, 2, 3], [-0.004, 0.5, 6.0]]


def test_rows_without_numbers_are_not_a_number() -> None:
    table = parse_table(b"x_m,y_m,z_m\nnan,1,2\n,,\n1,-inf,2\n", "p.csv", COLUMNS)
    np.testing.assert_array_equal(table, [[np.nan, 1, 2], [np.nan] * 3, [1, -np.inf, 2]])


def test_a_table_without_rows_is_empty() -> None:
    assert parse_table(b"x_m,y_m,z_m\n", "p.csv", COLUMNS).shape == (0, 3)


@pytest.mark.parametrize(
    ("text", "place", "phrase"),
    [
        (b"x,y,z\n1,2,3\n", "line 1", "expected 'x_m,y_m,z_m'"),
        (b"y_m,x_m,z_m\n1,2,3\n", "line 1", "expected 'x_m,y_m,z_m'"),
        (b"1,2,3\n", "line 1", "expected 'x_m,y_m,z_m'"),
        (b"x_m;y_m;z_m\n1;2;3\n", "line 1", "separated by ';'"),
        (b"x_m\ty_m\tz_m\n1\t2\t3\n", "line 1", "separated by tab"),
        (b"x_m,y_m,z_m\n1,2,3\n1;2;3\n", "row 2 (line 3)", "1 cells where 3"),
        (b"x_m,y_m,z_m\n1,2\n", "row 1 (line 2)", "2 cells where 3"),
        (b"x_m,y_m,z_m\n1,2,3,\n", "row 1 (line 2)", "4 cells where 3"),
        (b"x_m,y_m,z_m\n1,2,3\n4,five,6\n", "row 2 (line 3), y_m", "'five'"),
        (b"x_m,y_m,z_m\n1,,3\n", "row 1 (line 2), y_m", "''"),
        (b"x_m,y_m,z_m\n1,1_0,3\n", "row 1 (line 2), y_m", "'1_0'"),
        (b"x_m,y_m,z_m\r1,1_0,3\r", "row 1 (line 2), y_m", "'1_0'"),
        (b"x_m,y_m,z_m\n1,0x1,3\n", "row 1 (line 2), y_m", "'0x1'"),
        ("x_m,y_m,z_m\n1,٣,3\n".encode(), "row 1 (line 2), y_m", "number"),
        (b"x_m,y_m,z_m\n1,2,3\n\n4,5,6\n", "line 3", "blank"),
        (b"x_m,y_m,z_m\n\xff,2,3\n", "line 2", "not UTF-8"),
        (b'x_m,y_m,z_m\n"1,2,3\n', "line 2", "CSV"),
        (b"x_m,y_m,z_m\n" + b"1" * 200_000 + b",2,3\n", "line 2", "CSV"),
        (b"\n\n", "line 1", "expected"),
    ],
)
def test_a_malformed_table_is_refused_with_row_and_reason(text: bytes, place: str, phrase: str) -> None:
    with pytest.raises(BadFile) as refused:
        parse_table(text, "p.csv", COLUMNS)
    assert refused.value.place == place
    assert phrase in refused.value.reason
    assert "\n" not in str(refused.value)


def test_a_written_table_comes_back_bit_for_bit(tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    values = rng.normal(size=(500, 3)) * 10.0 ** rng.integers(-300, 300, (500, 3))
    values[7] = [np.nan, 1, 2]
    stream = io.StringIO()
    write_table(stream, COLUMNS, values)
    lines = stream.getvalue().splitlines()
    assert (len(lines), lines[8]) == (501, ",,")
    (tmp_path / "p.csv").write_text(stream.getvalue())
    expected = np.where(np.isfinite(values).all(axis=1)[:, None], values, np.nan)  # type: ignore[index]
    np.testing.assert_array_equal(read_table(tmp_path / "p.csv", COLUMNS), expected)
