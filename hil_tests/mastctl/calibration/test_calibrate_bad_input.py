"""``mastctl calibrate`` on surveys with one mistake each: refused in a sentence, or named in the result."""

from __future__ import annotations

import csv
import json
import shutil
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import pytest

from calib.survey.reader import read_survey
from calib.survey.records import Survey
from hil_tests.mastctl.calibration.survey_world import navcam_survey, write_folder
from hil_tests.support.sim_survey.blunders import (
    with_swapped_boards,
    with_wrong_prism,
)
from mastctl.calibration.run import FITS, checked_survey, with_dots
from mastctl.calibration.verdict import judge
from mastctl.cli.main import main

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


def with_picture(data: bytes | None) -> Callable[[Path], None]:
    """Let the first image have a picture and no dots."""

    def change(folder: Path) -> None:
        if data is not None:
            (folder / "one.png").write_bytes(data)
        rows(folder / IMAGES, lambda c, at: c | {"file": "one.png"} if at == 2 else c)
        rows(folder / DOTS, lambda c, _: None if c["image"] == "navcam_left-001" else c)

    return change


class Refused(NamedTuple):
    """What is done to the folder, and words that the one sentence must hold: where, what, what is right."""

    spoil: Callable[[Path], None]
    words: tuple[str, ...]


STATION, IMAGES, DOTS = "station.csv", "images.csv", "dots.csv"

REFUSALS: dict[str, Refused] = {
    "NaN in the station": Refused(cell(STATION, 4, "x_m", "NaN"), (STATION, "line 4, x_m", "NaN", "finite")),
    "neither dots nor pictures": Refused(
        lambda folder: (folder / DOTS).unlink(), ("20 of 20 images", "neither dots", "no file is named")
    ),
    "a picture that is not there": Refused(
        with_picture(None), (IMAGES, "line 2", "one.png is missing", "Put the picture there")
    ),
    "a picture of another size": Refused(
        with_picture(cv2.imencode(".png", np.zeros((480, 640), np.uint8))[1].tobytes()),
        (IMAGES, "line 2, file", "640x480", "1024x768"),
    ),
}
"""One of each kind: calib/survey has what its reader and its check find."""


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


def written(survey: Survey, folder: Path) -> Path:
    return write_folder(survey, folder / "t")


def test_warnings_go_into_the_result_and_its_verdict(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, told = calibrate(capsys, written(navcam_survey(1, check_boards=0)[0], tmp_path))
    assert code == 0, told
    assert "no image of purpose check" in " ".join(told["warnings"])
    assert told["verdict"]["grade"] == "care"


# What is wrong only here and there is left out and named. Each kind of mistake comes by each method, but not
# in each size and place. hil_tests/calib/adjust/test_outliers.py has what both methods leave out.


class Judged(NamedTuple):
    """What a survey comes to: the grade, its reasons in a row, and names of what was left out."""

    grade: str
    reasons: str
    left_out: list[str]


def judged(survey: Survey) -> Judged:
    """What the command does with a survey before it writes anything; the fit must be as good as the noise."""
    fit = FITS["joint"](survey, 6)
    verdict = judge(survey, fit, checked_survey(survey, "joint"))
    assert all(0.08 < value < 0.12 for pair in fit.rms_px.values() for value in pair), fit.rms_px
    reasons = " | ".join(reason.sentence for reason in verdict.reasons)
    return Judged(verdict.grade, reasons, [outlier.name for outlier in fit.outliers])


def test_a_prism_that_is_off_is_left_out_and_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = written(with_wrong_prism(navcam_survey(1)[0], "level", "p2", (0.003, 0.0032, 0.0024)), tmp_path)
    code, answer = calibrate(capsys, folder)
    assert code == 0
    assert answer["verdict"]["grade"] == "care"
    assert "measure again: prism p2 of set-up level" in [r["sentence"] for r in answer["verdict"]["reasons"]]


def test_two_boards_mixed_up_are_named() -> None:
    boards = ("navcam-3m-1", "navcam-3m-2")
    survey = navcam_survey(1)[0]
    wrong = {f"image {image.name}" for image in survey.images if image.placement in boards}
    _, reasons, left_out = judged(with_swapped_boards(survey, "level", *boards))
    assert set(left_out) == wrong
    for own, other in (boards, boards[::-1]):
        assert f"cannot show placement {own} but would show {other} (set-up level): are they exch" in reasons


@pytest.mark.parametrize(
    ("image", "own", "other"), [(IMAGE, "mast-3", "mast-4"), (CHECK, "check-1", "mast-8")]
)
def test_an_image_with_the_placement_of_another_is_named_with_its_own(
    folder: Path, capsys: pytest.CaptureFixture[str], image: str, own: str, other: str
) -> None:
    rows(folder / IMAGES, lambda c, _: c | {"placement": other} if c["image"] == image else c)
    # Drawing a report takes longer than all the rest; an image without any pixels is the hard one to draw.
    if image == CHECK:
        code, told = calibrate(capsys, folder, "--report", str(folder.parent / "r"))
        assert code == 0, told
        verdict = told["verdict"]
        reasons = " | ".join(reason["sentence"] for reason in verdict["reasons"])
        found = Judged(verdict["grade"], reasons, [outlier["name"] for outlier in told["outliers"]])
    else:
        found = judged(read_survey(folder))
    assert f"image {image} cannot show placement {other} but would show {own} (set-up level)" in found.reasons
    assert found.grade == ("bad" if image == CHECK else "care")
    assert found.left_out == ([] if image == CHECK else [f"image {image}"])


def test_a_picture_that_cannot_be_read_is_named_with_the_reason(
    folder: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    with_picture(b"no picture")(folder)
    survey = read_survey(folder)
    with ThreadPoolExecutor(1) as executor:
        found, undetected = with_dots(survey, executor)
    assert capfd.readouterr().err == "", "nothing but the reason is reported"
    reason = "one.png is not a picture that can be read: a PNG or JPEG file is expected"
    assert undetected == (("navcam_left-001", reason),)
    assert len(found.dots) == len(survey.images) - 1


# Where the result shall go


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--out", "none/m.yaml"], "there is no folder"),
        (["--out", "s"], "is a folder"),
        (["--out", "s/survey.yaml"], "is a file of the survey itself"),
        (["--out", "/proc/m.yaml"], "nothing can be written to /proc"),
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
