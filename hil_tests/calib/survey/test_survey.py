"""The survey folder: strict in, whole or not at all out."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from calib.errors import BadFile
from calib.files.pictures import decode_picture, spoiled_png
from calib.survey.reader import read_survey
from calib.survey.records import Survey
from calib.survey.writer import write_survey
from hil_tests.calib.survey.survey_case import CLICKS, DOTS, FILES, IMAGES, write_files


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_files(tmp_path / "survey")


def test_a_survey_is_read_as_written(folder: Path) -> None:
    survey = read_survey(folder)
    assert (survey.board.rows, survey.board.columns, survey.board.spacing_m) == (3, 4, 0.08)
    assert survey.sigma.joint_rad == survey.sigma.prism_cad_m == 0.0
    assert survey.prisms_in_rover_m["p3"].tolist() == [-0.3, -0.25, -0.9]
    rough_A = survey.cameras["navcam_right"].rough_A
    assert rough_A is not None and rough_A.tolist() == [1.0, 0.0, 0.0]
    assert survey.cameras["navcam_left"].rough_C_m is None
    assert survey.stereo == {"navcam": ("navcam_left", "navcam_right")}
    last = survey.station[-1]
    assert (last.kind, last.placement, last.point, last.row) == ("check", "", "brick", 9)
    assert [(i.pan_rad, i.tilt_rad) for i in survey.images[1:3]] == [(0.25, -0.3), (None, None)]
    assert [i.file for i in survey.images[:2]] == [Path("one.png"), Path()]
    assert survey.dots["one"].rows.tolist() == [0, 0, 2]
    assert survey.dots["one"].pixels_px.tolist() == [[400.5, 300.25], [434.5, 300.5], [502.0, 368.0]]
    assert survey.clicks[0].pixel_px.tolist() == [612.0, 401.0]


def test_first_dot_of_the_board_is_up_and_to_the_left(folder: Path) -> None:
    board = read_survey(folder).board
    assert np.allclose(board.dots_in_board_m([0, 2], [0, 3]), [[-0.12, -0.08, 0], [0.12, 0.08, 0]])


def test_dots_and_clicks_may_be_left_out(tmp_path: Path) -> None:
    survey = read_survey(write_files(tmp_path, dots=None, clicks=None))
    assert survey.dots == {}
    assert survey.clicks == ()


def test_windows_line_ends_byte_order_mark_and_blank_end_change_nothing(tmp_path: Path, folder: Path) -> None:
    other = write_files(tmp_path / "other")
    (other / "dots.csv").write_bytes(b"\xef\xbb\xbf" + DOTS.replace("\n", "\r\n").encode() + b"\r\n\r\n")
    assert np.array_equal(read_survey(other).dots["one"].pixels_px, read_survey(folder).dots["one"].pixels_px)


Refusal = tuple[str, str, str, str, str]

REFUSALS: dict[str, Refusal] = {
    # file, what is replaced, by what, place, part of the reason
    "no such key": ("survey", "stereo:", "stero:", "stero", "nearest known is 'stereo'"),
    "another schema": ("survey", "survey/1", "survey/2", "schema", "'mastctl/survey/1' is expected"),
    "a key is missing": ("survey", "  spacing_m: 0.08\n", "", "board.spacing_m", "missing"),
    "board key": ("survey", "spacing_m", "spacing", "board.spacing", "nearest known is 'spacing_m'"),
    "no float's sigma": (
        "survey",
        "station_m: 0.001",
        "station_m: 1e-320",
        "sigma.station_m",
        "from 1e-09",
    ),
    "zero spacing": ("survey", "spacing_m: 0.08", "spacing_m: 0", "board.spacing_m", "above 0"),
    "no float's square": (
        "survey",
        "{station_m: 0.001",
        "{joint_rad: 1.0e-320, station_m: 0.001",
        "sigma.joint_rad",
        "0 or at least 1e-09",
    ),
    "dots touch": ("survey", "dot_diameter_m: 0.04", "dot_diameter_m: 0.08", "board.dot_diameter_m", "less"),
    "two tapes": ("survey", ", c: [-0.2, 0.2, 0]", "", "board.tapes_in_board_m", "2 tapes"),
    "tapes on a line": (
        "survey",
        "c: [-0.2, 0.2, 0]",
        "c: [0, -0.2, 0]",
        "board.tapes_in_board_m",
        "one line",
    ),
    "NaN in yaml": (
        "survey",
        "[-0.3, -0.25, -0.9]",
        "[-0.3, .nan, -0.9]",
        "prisms_in_rover_m.p3[1]",
        "finite",
    ),
    "camera name": ("survey", "  hazcam_left:", "  haz cam:", "cameras.haz cam", "letters, digits"),
    "no such model": ("survey", "model: CAHVORE", "model: CAHVAR", "cameras.hazcam_left.model", "CAHVORE"),
    "no such pair": (
        "survey",
        "[navcam_left, navcam_r",
        "[navcm_left, navcam_r",
        "stereo.navcam",
        "no camera",
    ),
    "no direction": ("survey", "A: [2, 0, 0]", "A: [0, 0, 0]", "cameras.navcam_right.rough.A", "zero"),
    "station columns": ("station", "x_m,y_m", "y_m,x_m", "line 1", "expected 'setup,kind"),
    "station number": ("station", "1.10,-0.25,-0.75", "1.10,nan,-0.75", "line 2, y_m", "finite"),
    "station word": ("station", "1.10,-0.25,-0.75", "1.10,0;25,-0.75", "line 2, y_m", "a number is expected"),
    "station hole": ("station", "1.10,-0.25,-0.75", "1.10,,-0.75", "line 2, y_m", "a number is expected"),
    "too far": ("station", "1.10,-0.25,-0.75", "1.1e9,0,-0.75", "line 2, x_m", "up to 100000"),
    "short row": ("station", ",1.10,-0.25,-0.75", ",1.10,-0.25", "line 2", "6 cells where 7"),
    "no such kind": (
        "station",
        "level,prism,,p1",
        "level,prsm,,p1",
        "line 2, kind",
        "nearest known is 'prism'",
    ),
    "no such prism": ("station", "prism,,p1", "prism,,P1", "line 2, point", "nearest known is 'p1'"),
    "no such tape": ("station", "near,b", "near,bb", "line 7, point", "no tape"),
    "prism placed": ("station", "prism,,p1", "prism,near,p1", "line 2, placement", "empty"),
    "tape not placed": ("station", "tape,near,b", "tape,,b", "line 7, placement", "is empty"),
    "station twice": ("station", "near,b", "near,a", "line 7", "twice, first on line 6"),
    "blank row": ("station", "level,tape,near,a", "\nlevel,tape,near,a", "line 6", "blank"),
    "no such camera": (
        "images",
        "hazcam_left",
        "hazcam_lft",
        "line 4, camera",
        "nearest known is 'hazcam_left'",
    ),
    "no such set-up": ("images", "one,navcam_left,level", "one,navcam_left,lvl", "line 2, setup", "'level'"),
    "no such purpose": ("images", "near,mast", "near,masts", "line 3, purpose", "nearest known is 'mast'"),
    "image not placed": ("images", "level,near,mast", "level,,mast", "line 3, placement", "is empty"),
    "body camera turned": ("images", "camera,,,", "camera,0,,", "line 4, pan_rad", "is on the body"),
    "head without tilt": ("images", "0.25,-0.3,", "0.25,,", "line 3, tilt_rad", "is on the head"),
    "pan not finite": ("images", "0.25,-0.3,", "inf,-0.3,", "line 3, pan_rad", "finite"),
    "image twice": ("images", "two,navcam", "one,navcam", "line 3", "image one is there twice"),
    "file twice": ("images", "-0.3,", "-0.3,one.png", "line 3", "file one.png is there twice"),
    "dots of no image": ("dots", "three,1", "tree,1", "line 5, image", "nearest known is 'three'"),
    "row beyond": ("dots", "one,2,3", "one,3,3", "line 4, row", "integer from 0 to 2"),
    "half a column": ("dots", "one,2,3", "one,2,2.5", "line 4, column", "integer from 0 to 3"),
    "dot twice": ("dots", "one,0,1", "one,0,0", "line 3", "twice, first on line 2"),
    "dot outside": (
        "dots",
        "400.5,300.25",
        "300.25,800.5",
        "line 2, y_px",
        "outside the image of navcam_left",
    ),
    "dot not finite": ("dots", "400.5,", "NaN,", "line 2, x_px", "finite"),
    "no such point": ("clicks", "brick", "brik", "line 2, point", "nearest known is 'brick'"),
    "click twice": ("clicks", CLICKS[-20:], CLICKS[-20:] + "four,brick,1,2\n", "line 3", "there twice"),
}


@pytest.mark.parametrize("case", REFUSALS)
def test_what_is_wrong_is_refused_with_its_place(tmp_path: Path, case: str) -> None:
    name, old, new, place, phrase = REFUSALS[case]
    texts = {key.partition(".")[0]: text for key, text in FILES.items()}
    assert old in texts[name]
    write_files(tmp_path, **{name: texts[name].replace(old, new, 1)})
    with pytest.raises(BadFile) as caught:
        read_survey(tmp_path)
    assert caught.value.path.name.startswith(name)
    assert caught.value.place == place
    assert phrase in caught.value.reason


@pytest.mark.parametrize("name", ["survey.yaml", "station.csv", "images.csv"])
def test_a_missing_file_is_named(folder: Path, name: str) -> None:
    (folder / name).unlink()
    with pytest.raises(BadFile, match="is missing") as caught:
        read_survey(folder)
    assert caught.value.path.name == name


def test_a_folder_that_is_none_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadFile, match="is no folder"):
        read_survey(tmp_path / "none")


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tiff", ".bmp", ".pgm", ".webp"])
@pytest.mark.parametrize("grey", [True, False])
def test_a_picture_of_another_size_is_refused(folder: Path, suffix: str, grey: bool) -> None:
    table = IMAGES.replace("one.png", f"one{suffix}")
    (folder / "images.csv").write_text(table)
    picture = np.zeros((768, 1024) if grey or suffix == ".pgm" else (768, 1024, 3), dtype=np.uint8)
    assert cv2.imwrite(str(folder / f"one{suffix}"), picture)
    assert read_survey(folder).images[0].file == Path(f"one{suffix}")
    assert cv2.imwrite(str(folder / f"one{suffix}"), picture[:480, :640])
    with pytest.raises(BadFile, match=r"is 640x480 pixels where navcam_left of survey\.yaml has 1024x768"):
        read_survey(folder)


def test_digest_holds_every_file_and_no_machine(tmp_path: Path, folder: Path) -> None:
    (folder / "one.png").write_bytes(b"no picture")
    digest = read_survey(folder).digest
    assert len(digest) == 64
    moved = tmp_path / "elsewhere" / "survey"
    shutil.copytree(folder, moved)
    assert read_survey(moved).digest == digest
    digests = {digest}
    for name in (*FILES, "one.png"):
        data = (folder / name).read_bytes()
        (folder / name).write_bytes(data + b"\n")
        digests.add(read_survey(folder).digest)
        (folder / name).write_bytes(data)
    (folder / "notes.txt").write_text("not part of it")
    assert read_survey(folder).digest == digest
    assert len(digests) == len(FILES) + 2


def contents(survey: Survey) -> list[object]:
    """Everything that a survey holds but for its folder and digest, as plain values."""
    board = vars(survey.board) | {"tapes_in_board_m": _plain(survey.board.tapes_in_board_m)}
    return [
        board,
        _plain(survey.prisms_in_rover_m),
        survey.sigma,
        [(n, c.on, c.size_px, c.kind, c.focal_px) for n, c in survey.cameras.items()],
        survey.stereo,
        [(p.setup, p.kind, p.placement, p.point, *p.position_m, p.row) for p in survey.station],
        [vars(image) for image in survey.images],
        {n: (d.rows.tolist(), d.columns.tolist(), d.pixels_px.tolist()) for n, d in survey.dots.items()},
        [(c.image, c.point, *c.pixel_px) for c in survey.clicks],
    ]


def _plain(places: Mapping[str, np.ndarray]) -> dict[str, list[float]]:
    return {name: place.tolist() for name, place in places.items()}


def test_what_is_written_is_read_back_to_the_last_bit(tmp_path: Path, folder: Path) -> None:
    survey = read_survey(folder)
    survey.station[0].position_m.setflags(write=True)
    survey.station[0].position_m[:] = np.pi, 1 / 3, 1e-17
    written = write_survey(survey, tmp_path / "new" / "copy", [("pictures/x.png", b"x")])
    assert contents(survey) == contents(written)
    rough_C_m = written.cameras["navcam_right"].rough_C_m
    assert rough_C_m is not None and rough_C_m.tolist() == [0.4, 0.1, -1.4]
    assert (tmp_path / "new/copy/pictures/x.png").read_bytes() == b"x"
    again = write_survey(written, tmp_path / "again", [("pictures/x.png", b"x")])
    assert again.digest == written.digest


def test_a_survey_is_never_written_over_another(folder: Path) -> None:
    survey = read_survey(folder)
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    with pytest.raises(BadFile, match="not empty"):
        write_survey(survey, folder)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
    assert [path.name for path in folder.parent.iterdir()] == [folder.name]


def test_a_writing_that_fails_leaves_nothing(tmp_path: Path, folder: Path) -> None:
    survey = read_survey(folder)

    def pictures() -> Iterator[tuple[str, bytes]]:
        yield "one.png", b"good"
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_survey(survey, tmp_path / "new", pictures())
    with pytest.raises(BadFile, match="outside"):
        write_survey(survey, tmp_path / "new", [("../one.png", b"bad")])
    survey.station[0].position_m.setflags(write=True)
    survey.station[0].position_m[0] = np.nan
    with pytest.raises(BadFile, match=r"station\.csv: line 2, x_m: nan"):
        write_survey(survey, tmp_path / "new")
    assert [path.name for path in tmp_path.iterdir()] == [folder.name]


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(head=st.sampled_from([b"\x89PNG\r\n\x1a\n", b"\xff\xd8", b""]), rest=st.binary(max_size=60))
def test_any_bytes_of_a_picture_are_taken_or_refused(tmp_path: Path, head: bytes, rest: bytes) -> None:
    folder = write_files(tmp_path / "survey")
    (folder / "one.png").write_bytes(head + rest)
    try:
        read_survey(folder)
    except BadFile as error:
        assert "one.png is" in error.reason


def test_files_of_a_survey_are_on_disk_before_the_folder_is_named(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A machine that loses its power after the renaming must not be left with empty files."""
    survey, target = read_survey(folder), tmp_path / "new"
    fsync, early = os.fsync, set()

    def noted(descriptor: int) -> None:
        fsync(descriptor)
        if not target.exists():
            early.add(Path(f"/proc/self/fd/{descriptor}").readlink().name)

    monkeypatch.setattr(os, "fsync", noted)
    write_survey(survey, target, [("pictures/x.png", b"x")])
    written = {path.name for path in target.rglob("*") if path.is_file()}
    assert {"survey.yaml", "station.csv", "images.csv", "x.png"} <= written <= early


@pytest.mark.parametrize("interval", [0, 4], ids=["one piece", "restart markers"])
def test_a_jpeg_whose_data_end_before_its_picture_is_refused(interval: int) -> None:
    grey = cv2.GaussianBlur(np.random.default_rng(1).integers(0, 256, (96, 96), np.uint8), (0, 0), 1.0)
    for picture in (grey, np.full_like(grey, 128)):  # the grey of a part that is missing
        whole = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_RST_INTERVAL, interval])[1].tobytes()
        np.testing.assert_array_equal(decode_picture(whole), cv2.imdecode(np.frombuffer(whole, np.uint8), 0))
        # Cameras add zeros, and some a second picture such as a preview.
        for more in (bytes(99), whole):
            np.testing.assert_array_equal(decode_picture(whole + more), decode_picture(whole))
    whole = cv2.imencode(".jpg", grey, [cv2.IMWRITE_JPEG_RST_INTERVAL, interval])[1].tobytes()
    for at in range(len(whole) // 2, len(whole) - 60, 97):
        with pytest.raises(ValueError, match="cut short or damaged"):
            decode_picture(whole[:at] + b"\xff\xd9")
        with pytest.raises(ValueError, match="cut short or damaged"):
            decode_picture(whole[:at] + whole)


def test_a_png_is_whole_to_its_last_byte_or_said_to_be_cut_short() -> None:
    whole = cv2.imencode(".png", np.arange(64, dtype=np.uint8).reshape(8, 8))[1].tobytes()
    assert spoiled_png(whole) is None
    assert spoiled_png(whole + b"more") is None, "what follows the end is nobody's"
    for length in range(8, len(whole)):
        assert spoiled_png(whole[:length]) == "it is cut short", length
    damaged = bytearray(whole)
    damaged[40] ^= 1
    assert spoiled_png(bytes(damaged)) == "a part of it is damaged"
    assert spoiled_png(b"\xff\xd8 a JPEG") is None
