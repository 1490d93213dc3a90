"""``mastctl calibrate`` on surveys with one mistake each: refused in a sentence, or named in the result."""

from __future__ import annotations

import csv
import json
import shutil
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import pytest

from calib.adjust.result import Calibration
from calib.calibrate.paper import fit_paper
from calib.survey.check import check_survey
from calib.survey.reader import read_survey
from calib.survey.records import Survey, SurveyImage
from calib.targets.boards import Dots
from hil_tests.calib.adjust.small_surveys import with_shifted_dots
from hil_tests.mastctl.calibration.survey_world import edit_yaml, navcam_survey, write_folder
from mastctl.calibration.detection import with_dots
from mastctl.calibration.run import FITS, Method, checked_survey, sentence_of
from mastctl.calibration.verdict import judge_calibration
from mastctl.cli.main import main
from tools.sim_survey.blunders import (
    with_moved_tape,
    with_outlier_dots,
    with_swapped_boards,
    with_wrong_prism,
)
from tools.sim_survey.plan import Ring

Cells = dict[str, str]
IMAGE = "navcam_left-021"
"""An image for the mast, at placement mast-3."""

CHECK = "navcam_left-033"


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_folder(navcam_survey(1)[0], tmp_path_factory.mktemp("good") / "s")


@pytest.fixture
def folder(good: Path, tmp_path: Path) -> Path:
    """A copy of the good survey, to be spoiled."""
    return shutil.copytree(good, tmp_path / "s")


def calibrate(capsys: pytest.CaptureFixture[str], folder: Path, *words: str) -> tuple[int, dict[str, Any]]:
    """Run the command with --json; nothing but one JSON document on stdout, and never a traceback."""
    capsys.readouterr()
    code = main(["calibrate", str(folder), "--out", str(folder.parent / "m.yaml"), "--json", *words])
    told = capsys.readouterr()
    assert "Traceback" not in told.out + told.err
    document = json.loads(told.out, parse_constant=lambda word: pytest.fail(f"{word} is no JSON"))
    assert (code != 0) == ("error" in document)
    return code, document


def rows(path: Path, change: Callable[[Cells, int], Cells | list[Cells] | None]) -> None:
    """Rewrite a CSV file row by row (the first is line 2); None takes a row out."""
    with path.open(newline="") as file:
        table = list(csv.DictReader(file))
    names = list(table[0])
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, names, lineterminator="\n")
        writer.writeheader()
        for line, cells in enumerate(table, start=2):
            made = change(cells, line)
            writer.writerows([made] if isinstance(made, dict) else made or [])


def cell(name: str, line: int, column: str, value: str) -> Callable[[Path], None]:
    def change(cells: Cells, at: int) -> Cells:
        return {**cells, column: value} if at == line else cells

    return lambda folder: rows(folder / name, change)


def exchanged(name: str, one: str, other: str) -> Callable[[Path], None]:
    return lambda folder: rows(folder / name, lambda c, _: {**c, one: c[other], other: c[one]})


def scaled(name: str, columns: tuple[str, ...], factor: float) -> Callable[[Path], None]:
    def change(cells: Cells, _: int) -> Cells:
        return cells | {column: repr(float(cells[column]) * factor) for column in columns}

    return lambda folder: rows(folder / name, change)


def repeated(name: str) -> Callable[[Path], None]:
    return lambda folder: rows(folder / name, lambda c, line: [c, c] if line == 5 else c)


def without(name: str, which: Callable[[Cells], bool]) -> Callable[[Path], None]:
    return lambda folder: rows(folder / name, lambda c, _: None if which(c) else c)


def without_images(which: Callable[[Cells], bool]) -> Callable[[Path], None]:
    """Take images out, and their dots."""

    def change(folder: Path) -> None:
        with (folder / IMAGES).open(newline="") as file:
            names = {cells["image"] for cells in csv.DictReader(file) if which(cells)}
        for name in (IMAGES, DOTS):
            rows(folder / name, lambda c, _: None if c["image"] in names else c)

    return change


def with_picture(data: bytes | None) -> Callable[[Path], None]:
    """Let the first image have a picture and no dots."""

    def change(folder: Path) -> None:
        if data is not None:
            (folder / "one.png").write_bytes(data)
        rows(folder / IMAGES, lambda c, at: c | {"file": "one.png"} if at == 2 else c)
        rows(folder / DOTS, lambda c, _: None if c["image"] == "navcam_left-001" else c)

    return change


def folder_for_images(folder: Path) -> None:
    (folder / IMAGES).unlink()
    (folder / IMAGES).mkdir()


def other_header(folder: Path) -> None:
    path = folder / STATION
    path.write_text(path.read_text().replace("x_m,y_m", "y_m,x_m", 1))


def copied_point(folder: Path) -> None:
    rows(folder / STATION, lambda c, at: c | dict.fromkeys(XYZ, "1.5") if at in (8, 9) else c)


def yaml_edit(change: Callable[[dict[str, Any]], Any]) -> Callable[[Path], None]:
    return lambda folder: edit_yaml(folder, change)


def content(name: str, data: bytes) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        (folder / name).write_bytes(data)

    return change


def gone(name: str) -> Callable[[Path], None]:
    return lambda folder: (folder / name).unlink()


def header_only(name: str) -> Callable[[Path], None]:
    return lambda folder: rows(folder / name, lambda *_: None)


class Refused(NamedTuple):
    """What is done to the folder, and words that the one sentence must hold: where, what, what is right."""

    spoil: Callable[[Path], None]
    words: tuple[str, ...]


STATION, IMAGES, DOTS = "station.csv", "images.csv", "dots.csv"
XYZ = ("x_m", "y_m", "z_m")
DEGREES = 57.29577951308232
FEET = 1 / 0.3048

REFUSALS: dict[str, Refused] = {
    "NaN in the station": Refused(cell(STATION, 4, "x_m", "NaN"), (STATION, "line 4, x_m", "NaN", "finite")),
    "NaN in an angle": Refused(cell(IMAGES, 4, "pan_rad", "nan"), (IMAGES, "line 4, pan_rad", "finite")),
    "NaN in a dot": Refused(cell(DOTS, 4, "y_px", "nan"), (DOTS, "line 4, y_px", "nan", "finite")),
    "infinite prism": Refused(
        yaml_edit(lambda d: d["prisms_in_rover_m"].update(p1=[0.1, float("inf"), 0.2])), ("p1[1]", "finite")
    ),
    "x and y of the station": Refused(
        exchanged(STATION, "x_m", "y_m"), (STATION, "two columns of coordinates are swapped", "right-handed")
    ),
    "header of the station": Refused(
        other_header, (STATION, "line 1", "expected 'setup,kind,placement,point,x_m,y_m,z_m'")
    ),
    "x and y of the dots": Refused(exchanged(DOTS, "x_px", "y_px"), (DOTS, "outside the image", "1024x768")),
    "row and column": Refused(exchanged(DOTS, "row", "column"), (DOTS, "in a mirror", "row and column are")),
    "pan and tilt": Refused(
        exchanged(IMAGES, "pan_rad", "tilt_rad"), (IMAGES, "are exchanged", "tilt looks up")
    ),
    "sign of pan": Refused(
        scaled(IMAGES, ("pan_rad",), -1.0), (IMAGES, "sign of pan_rad is wrong", "turns right")
    ),
    "sign of tilt": Refused(
        scaled(IMAGES, ("tilt_rad",), -1.0), (IMAGES, "sign of tilt_rad is wrong", "looks up")
    ),
    "a station row twice": Refused(repeated(STATION), (STATION, "line 6", "twice, first on line 5")),
    "an image row twice": Refused(repeated(IMAGES), (IMAGES, "line 6", "twice, first on line 5")),
    "a dot row twice": Refused(repeated(DOTS), (DOTS, "line 6", "twice, first on line 5")),
    "a measurement copied": Refused(copied_point, (STATION, "line 9", "line 8", "one is a copy")),
    "both angles in degrees": Refused(
        scaled(IMAGES, ("pan_rad", "tilt_rad"), DEGREES), (IMAGES, "pan_rad", "degrees", "write radians")
    ),
    "tilt in degrees": Refused(scaled(IMAGES, ("tilt_rad",), DEGREES), ("tilt_rad", "write radians")),
    "station in feet": Refused(scaled(STATION, XYZ, FEET), (STATION, "is in feet", "in metres")),
    "station in millimetres": Refused(scaled(STATION, XYZ, 1000.0), (STATION, "is in millimetres")),
    "tapes in feet": Refused(
        yaml_edit(
            lambda d: d["board"].update(
                tapes_in_board_m={
                    n: [float(x) * FEET for x in p] for n, p in d["board"]["tapes_in_board_m"].items()
                }
            )
        ),
        ("board.tapes_in_board_m", "is in feet", "in metres"),
    ),
    "spacing in feet": Refused(
        yaml_edit(lambda d: d["board"].update(spacing_m=0.08 * FEET, dot_diameter_m=0.04 * FEET)),
        ("camera navcam_left", "spacing_m", "0.3048"),
    ),
    "too few rows": Refused(
        yaml_edit(lambda d: d["board"].update(rows=9)), (DOTS, "line 92, row", "from 0 to 8")
    ),
    "too many rows": Refused(
        yaml_edit(lambda d: d["board"].update(rows=12)), ("board.rows", "12 rows", "in rows 0 to 9")
    ),
    "too many columns": Refused(yaml_edit(lambda d: d["board"].update(columns=11)), ("board.columns",)),
    "no rows": Refused(yaml_edit(lambda d: d["board"].update(rows=0)), ("board.rows", "from 2 to 200")),
    "unknown camera": Refused(
        cell(IMAGES, 2, "camera", "navcam_lft"), (IMAGES, "line 2, camera", "navcam_lft", "'navcam_left'")
    ),
    "image without placement": Refused(
        cell(IMAGES, 2, "placement", ""), (IMAGES, "line 2, placement", "is empty")
    ),
    "placement that nobody measured": Refused(
        cell(IMAGES, 2, "placement", "navcam-3m-11"), (IMAGES, "line 2", "has no tapes", "navcam-3m-1")
    ),
    "two tapes": Refused(
        without(STATION, lambda c: c["placement"] == "mast-3" and c["point"] == "b"),
        ("placement mast-3", "2 of three tapes", "Measure the missing tapes"),
    ),
    "two prisms": Refused(
        without(STATION, lambda c: c["point"] in ("p1", "p2")), ("set-up level", "2 prisms", "at least three")
    ),
    "tilt beyond its limit": Refused(
        cell(IMAGES, 2, "tilt_rad", "2.0"), (IMAGES, "line 2, tilt_rad", "-1.57 to 1.57", "2")
    ),
    "a head that never turned": Refused(
        without_images(lambda c: c["purpose"] != "camera"), ("the mast", "did not move", "purpose mast")
    ),
    "two boards for a camera": Refused(
        without_images(lambda c: c["camera"] == "navcam_left" and c["placement"] > "mast-2"),
        ("camera navcam_left", "2 placements", "3 are the least"),
    ),
    "no survey.yaml": Refused(gone("survey.yaml"), ("survey.yaml", "is missing")),
    "no station.csv": Refused(gone(STATION), (STATION, "is missing")),
    "no images.csv": Refused(gone(IMAGES), (IMAGES, "is missing")),
    "neither dots nor pictures": Refused(gone(DOTS), ("20 of 20 images", "neither dots", "no file is named")),
    "a picture that is not there": Refused(
        with_picture(None), (IMAGES, "line 2", "one.png is missing", "Put the picture there")
    ),
    "a picture of another size": Refused(
        with_picture(cv2.imencode(".png", np.zeros((480, 640), np.uint8))[1].tobytes()),
        (IMAGES, "line 2, file", "640x480", "1024x768"),
    ),
    **{f"empty {name}": Refused(content(name, b""), (name, "is empty")) for name in (STATION, IMAGES, DOTS)},
    "empty survey.yaml": Refused(content("survey.yaml", b""), ("survey.yaml", "is empty")),
    **{
        f"no row in {name}": Refused(header_only(name), (name, "has a header and no rows"))
        for name in (STATION, IMAGES)
    },
    **{
        f"bytes for {name}": Refused(content(name, bytes(range(256))), (name, "line 2", "0x80", "UTF-8"))
        for name in ("survey.yaml", STATION, IMAGES, DOTS)
    },
    "a folder for images.csv": Refused(folder_for_images, (IMAGES, "cannot be read")),
}


@pytest.mark.parametrize("mistake", REFUSALS)
def test_it_is_refused_in_one_sentence(
    folder: Path, capsys: pytest.CaptureFixture[str], mistake: str
) -> None:
    case = REFUSALS[mistake]
    case.spoil(folder)
    before = sorted(path.name for path in folder.parent.iterdir())
    code, told = calibrate(capsys, folder)
    message = told["error"]["message"]
    assert code == 2, message
    for word in case.words:
        assert word in message
    assert "\n" not in message and len(message) < 700
    assert sorted(path.name for path in folder.parent.iterdir()) == before, "a refusal writes nothing"


# Too little is no reason to stop, but is told.


def written(survey: Survey, folder: Path) -> Path:
    return write_folder(survey, folder / "t")


def few_images(survey: Survey, keep: Callable[[SurveyImage], bool]) -> Survey:
    images = tuple(image for image in survey.images if keep(image))
    dots = {image.name: survey.dots[image.name] for image in images}
    places = {(image.setup, image.placement) for image in images}
    station = tuple(p for p in survey.station if p.kind != "tape" or (p.setup, p.placement) in places)
    return replace(survey, images=images, dots=dots, station=station)


def narrow(survey: Survey, image: SurveyImage) -> Survey:
    dots = survey.dots[image.name]
    left = dots.pixels_px[:, 0] < 400
    kept = Dots(dots.rows[left], dots.columns[left], dots.pixels_px[left])
    return replace(survey, dots={**survey.dots, image.name: kept})


def left_part(survey: Survey) -> Survey:
    for image in survey.images:
        if image.camera == "navcam_left" and image.purpose == "camera":
            survey = narrow(survey, image)
    seen = {name for name, dots in survey.dots.items() if len(dots.rows)}
    return few_images(survey, lambda i: i.name in seen and (i.purpose == "camera" or "right" in i.camera))


THIN: dict[str, tuple[Callable[[], Survey], tuple[str, ...]]] = {
    "depth": (
        lambda: few_images(
            navcam_survey(1, rings=(Ring("navcam", 3.0, 4, -0.17), Ring("navcam", 3.2, 4, -0.17)))[0],
            lambda i: i.purpose == "camera",
        ),
        ("camera navcam_left", "stand between", "Photograph boards at about"),
    ),
    "image area": (
        lambda: left_part(navcam_survey(1)[0]),
        ("camera navcam_left", "of the picture", "Photograph boards in the right part"),
    ),
    "pan": (
        lambda: navcam_survey(1, pan_rad=0.1)[0],
        ("the mast", "pan goes from", "at other angles of pan"),
    ),
    "tilt": (
        lambda: few_images(navcam_survey(1)[0], lambda i: (i.tilt_rad or 0.0) > -0.19),
        ("the mast", "tilt goes from", "at other angles of tilt"),
    ),
    "check images": (
        lambda: navcam_survey(1, check_boards=0)[0],
        ("images.csv", "no image of purpose check", "two to four more placements"),
    ),
    "boards for the mast": (
        lambda: navcam_survey(1, mast_boards=4)[0],
        ("the mast", "4 placements of purpose mast", "Photograph more placements"),
    ),
    "prisms": (
        lambda: navcam_survey(1, prisms=3)[0],
        ("set-up level", "only three prisms", "Measure a fourth"),
    ),
}


@pytest.mark.parametrize("spread", THIN)
def test_too_little_is_told_with_what_to_measure(spread: str) -> None:
    make, words = THIN[spread]
    told = " | ".join(map(sentence_of, check_survey(make())))
    for word in words:
        assert word in told


def test_warnings_go_into_the_result_and_its_verdict(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, told = calibrate(capsys, written(THIN["check images"][0](), tmp_path))
    assert code == 0, told
    assert "no image of purpose check" in " ".join(told["warnings"])
    assert told["verdict"]["grade"] == "care"


# What is wrong only here and there is left out and named. Each kind of mistake comes by each method, but not
# in each size and place. calib/adjust/test_outliers.py asks for what both methods leave out of a survey.


def _other(*values: object) -> Any:
    """A case of the long run."""
    return pytest.param(
        *values, marks=pytest.mark.long(1, "another size, place or method; one of each is in the quick run")
    )


class Judged(NamedTuple):
    """What a survey comes to: the grade, its reasons in a row, and names of what was left out."""

    grade: str
    reasons: str
    left_out: list[str]


def judged(survey: Survey, method: Method = "joint") -> Judged:
    """What the command does with a survey before it writes anything."""
    fit = FITS[method](survey, 6)
    verdict = judge_calibration(survey, fit, checked_survey(survey, method))
    reasons = " | ".join(reason.sentence for reason in verdict.reasons)
    return Judged(verdict.grade, reasons, outliers_of(fit))


def outliers_of(fit: Calibration) -> list[str]:
    """Names of what was left out; the fit without it must be as good as the noise."""
    if fit.method == "joint":
        assert all(0.08 < value < 0.12 for pair in fit.rms_px.values() for value in pair), fit.rms_px
    return [outlier.name for outlier in fit.outliers]


def outliers(survey: Survey, method: Method = "joint") -> list[str]:
    """Names of what a fit leaves out of a survey that the check lets through."""
    checked_survey(survey, method)
    return outliers_of(FITS[method](survey, 6))


@pytest.mark.parametrize("shift_m", [_other(0.012), 1.0])
def test_a_tape_measured_wrongly_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], shift_m: float
) -> None:
    shift = np.array([0.6, 0.64, 0.48]) * shift_m
    folder = written(with_moved_tape(navcam_survey(1)[0], "level", "mast-2", "b", shift), tmp_path)
    code, told = calibrate(capsys, folder)
    assert code == 0, told
    assert all(0.08 < value < 0.12 for pair in told["rms_px"].values() for value in pair), told["rms_px"]
    names = [outlier["name"] for outlier in told["outliers"]]
    assert names == ["tape b of placement mast-2 (set-up level)"]


@pytest.mark.parametrize("shift_m", [0.02, _other(1.0)])
def test_the_papers_method_lists_the_images_of_a_board_with_a_wrong_tape(
    shift_m: float,
) -> None:
    survey = navcam_survey(1)[0]
    wrong = {f"image {image.name}" for image in survey.images if image.placement == "mast-2"}
    shift = np.array([0.6, 0.64, 0.48]) * shift_m
    moved = with_moved_tape(survey, "level", "mast-2", "b", shift)
    checked_survey(moved, "paper")
    fit = fit_paper(moved)
    assert set(outliers_of(fit)) == wrong
    assert any("tapes of placement mast-2 (set-up level)" in note for note in fit.notes)


@pytest.mark.parametrize(
    ("shift_m", "method"), [(0.012, "paper"), (1.0, "joint"), _other(0.012, "joint"), _other(1.0, "paper")]
)
def test_a_prism_measured_wrongly_is_named(shift_m: float, method: Method) -> None:
    shift = np.array([0.6, 0.64, 0.48]) * shift_m
    survey = with_wrong_prism(navcam_survey(1)[0], "level", "p2", shift)
    assert outliers(survey, method) == ["prism p2 of set-up level"]


def test_a_prism_that_may_be_any_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = written(with_wrong_prism(navcam_survey(1)[0], "level", "p2", (0.003, 0.0032, 0.0024)), tmp_path)
    code, told = calibrate(capsys, folder)
    assert code == 2
    assert "p2 and p3" in told["error"]["message"]
    assert "Measure the prisms of this set-up again" in told["error"]["message"]


@pytest.mark.parametrize(
    ("distance_px", "method"), [(1.0, "joint"), (40.0, "paper"), _other(40.0, "joint"), _other(1.0, "paper")]
)
def test_a_wrong_dot_is_named(distance_px: float, method: Method) -> None:
    rng = np.random.default_rng(5)
    survey, places = with_outlier_dots(navcam_survey(1)[0], IMAGE, 1, distance_px, rng)
    row, column = places[0]
    name = f"image {IMAGE} dot (row {row}, column {column})"
    assert outliers(survey, method) == [name]


@pytest.mark.parametrize("shift_px", [0.5, _other(30.0)])
def test_a_shifted_image_is_named(shift_px: float) -> None:
    shifted = with_shifted_dots(navcam_survey(1)[0], IMAGE, (shift_px, -shift_px))
    assert outliers(shifted) == [f"image {IMAGE}"]


def test_a_shifted_image_that_the_papers_method_keeps_is_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = written(with_shifted_dots(navcam_survey(1)[0], IMAGE, (3.0, -3.0)), tmp_path)
    code, told = calibrate(capsys, folder, "--method", "paper")
    assert code == 0
    assert told["verdict"]["grade"] == "care"
    assert f"image {IMAGE} is off by" in " ".join(r["sentence"] for r in told["verdict"]["reasons"])


CAMERA_BOARDS, MAST_BOARDS = ("navcam-3m-1", "navcam-3m-2"), ("mast-1", "mast-2")


@pytest.mark.parametrize(
    ("boards", "method"),
    [
        (CAMERA_BOARDS, "joint"),
        (MAST_BOARDS, "paper"),
        _other(CAMERA_BOARDS, "paper"),
        _other(MAST_BOARDS, "joint"),
    ],
)
def test_two_boards_mixed_up_are_named(boards: tuple[str, str], method: Method) -> None:
    survey = navcam_survey(1)[0]
    wrong = {f"image {image.name}" for image in survey.images if image.placement in boards}
    _, reasons, left_out = judged(with_swapped_boards(survey, "level", *boards), method)
    assert set(left_out) == wrong
    assert (
        f"the boards of placements {boards[0]} and {boards[1]} (set-up level) seem to be exchanged" in reasons
    )


@pytest.mark.parametrize(
    ("image", "own", "other", "method"),
    [
        (IMAGE, "mast-3", "mast-4", "joint"),
        (IMAGE, "mast-3", "mast-5", "joint"),  # behind the camera: it has no pixels at all
        (IMAGE, "mast-3", "mast-5", "paper"),
        ("navcam_right-006", "navcam-3m-3", "mast-8", "joint"),
        (CHECK, "check-1", "mast-2", "paper"),
        (CHECK, "check-1", "mast-8", "joint"),
        _other(IMAGE, "mast-3", "mast-4", "paper"),
        _other("navcam_right-006", "navcam-3m-3", "mast-8", "paper"),
        _other(CHECK, "check-1", "mast-2", "joint"),
        _other(CHECK, "check-1", "mast-8", "paper"),
    ],
)
def test_an_image_with_the_placement_of_another_is_told_whose_it_is(
    folder: Path, capsys: pytest.CaptureFixture[str], image: str, own: str, other: str, method: Method
) -> None:
    rows(folder / IMAGES, lambda c, _: c | {"placement": other} if c["image"] == image else c)
    # Drawing a report takes longer than all the rest; an image without any pixels is the hard one to draw.
    if method == "joint" and (image, other) in ((IMAGE, "mast-5"), (CHECK, "mast-8")):
        code, told = calibrate(capsys, folder, "--report", str(folder.parent / "r"))
        assert code == 0, told
        verdict = told["verdict"]
        reasons = " | ".join(reason["sentence"] for reason in verdict["reasons"])
        found = Judged(verdict["grade"], reasons, [outlier["name"] for outlier in told["outliers"]])
    else:
        found = judged(read_survey(folder), method)
    assert f"image {image} cannot show placement {other} but would show {own} (set-up level)" in found.reasons
    assert found.grade == ("bad" if image == CHECK else "care")
    assert found.left_out == ([] if image == CHECK else [f"image {image}"])


# Pictures that cannot be used


PNG = cv2.imencode(".png", np.random.default_rng(1).integers(0, 255, (768, 1024), np.uint8))[1].tobytes()


@pytest.mark.parametrize(
    ("data", "why"),
    [
        (b"", ""),
        (b"no picture", ""),
        (b"\x89PNG\r\n\x1a\n" + bytes(100), ": a part of it is damaged"),
        (PNG[: len(PNG) // 2], ": it is cut short"),
        (PNG[:-8], ": it is cut short"),
        (PNG[:9999] + b"!" + PNG[10000:], ": a part of it is damaged"),
    ],
    ids=["empty", "no picture", "zeros", "half", "no end", "one byte"],
)
def test_a_picture_that_cannot_be_read_is_named_with_the_reason(
    folder: Path, capfd: pytest.CaptureFixture[str], data: bytes, why: str
) -> None:
    with_picture(data)(folder)
    survey = read_survey(folder)
    with ThreadPoolExecutor(1) as executor:
        found, undetected = with_dots(survey, None, executor)
    assert capfd.readouterr().err == "", "nothing but the reason is told"
    assert undetected == (("navcam_left-001", f"one.png is not a picture that can be read{why}"),)
    assert len(found.dots) == len(survey.images) - 1


# Where the result shall go


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--out", "none/m.yaml"], "there is no folder"),
        (["--out", "s"], "is a folder"),
        (["--out", "s/survey.yaml"], "is a file of the survey itself"),
        (["--out", "s/../s/dots.csv"], "is a file of the survey itself"),
        (["--out", "/proc/m.yaml"], "nothing can be written to /proc"),
        (["--out", "/dev/null"], "no regular file"),
        (["--out", "m.yaml", "--report", "file"], "file is a file; a folder is expected"),
        (["--out", "m.yaml", "--report", "file/sub"], "file is a file; a folder is expected"),
        (["--out", "m.yaml", "--report", "/proc/r"], "nothing can be written to /proc"),
        (["--out", "m.yaml", "--in-use", "none.yaml"], "none.yaml: cannot be read"),
    ],
)
def test_a_result_that_has_no_place_is_refused_before_the_work(
    folder: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    words: list[str],
    told: str,
) -> None:
    monkeypatch.chdir(folder.parent)
    Path("file").write_text("mine")
    kept = {p: p.read_bytes() for p in Path().rglob("*") if p.is_file()}
    monkeypatch.setattr("mastctl.calibration.run.FITS", {})
    code, document = calibrate(capsys, folder, *words)
    assert code == 2
    assert told in document["error"]["message"]
    assert {p: p.read_bytes() for p in Path().rglob("*") if p.is_file()} == kept
