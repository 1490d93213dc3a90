"""The folder of a bench: boards of unknown place, corners, and a folder that grows while it is measured."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calib.errors import BadFile
from calib.geometry.mode import SensorMode
from calib.survey import writer as bench_writer
from calib.survey.check import check_survey
from calib.survey.reader import read_survey
from calib.survey.records import Sigma, SurveyCamera, SurveyImage
from calib.survey.writer import BenchFolder, write_survey
from calib.targets.boards import Charuco, Corners, DotBoard

YAML = """\
schema: mastctl/survey/1
boards:
  wall: {kind: charuco, columns: 9, rows: 12, square_m: 0.02, marker_m: 0.015, dictionary: DICT_5X5_100}
  desk: {kind: dots, columns: 4, rows: 3, spacing_m: 0.02, dot_diameter_m: 0.01}
sigma: {corner_px: 0.1, joint_rad: 0.0002}
cameras:
  navcam_left:
    {on: head, size_px: [1024, 768], model: CAHVOR, focal_px: 1290, sensor_mode: {flip: both}}
  hazcam_left: {on: rover, size_px: [640, 480], model: CAHVORE, focal_px: 309}
"""
IMAGES = """\
image,camera,placement,board,purpose,pan_rad,tilt_rad,pan_approach,tilt_approach,file
one,navcam_left,near,wall,camera,0.0,-0.17,1,-1,
two,hazcam_left,near,desk,camera,,,,,
three,navcam_left,far,wall,check,0.5,-0.2,0,0,
"""
CORNERS = """\
image,board,id,x_px,y_px
one,wall,0,400.5,300.25
one,wall,87,500.5,380.25
two,desk,11,100,200
"""


def folder_of(path: Path, yaml: str = YAML, images: str = IMAGES, corners: str = CORNERS) -> Path:
    path.mkdir(exist_ok=True)
    for name, text in (("survey.yaml", yaml), ("images.csv", images), ("corners.csv", corners)):
        if text:
            (path / name).write_text(text)
    return path


def test_a_bench_is_read_as_written(tmp_path: Path) -> None:
    survey = read_survey(folder_of(tmp_path))
    assert survey.boards == {"wall": Charuco(9, 12, 0.02, 0.015), "desk": DotBoard(4, 3, 0.02, 0.01)}
    assert (survey.sigma.corner_px, survey.sigma.joint_rad) == (0.1, 0.0002)
    assert [(i.board, i.placement, i.pan_approach, i.tilt_approach) for i in survey.images] == [
        ("wall", "near", 1, -1),
        ("desk", "near", 0, 0),
        ("wall", "far", 0, 0),
    ]
    assert survey.corners["one"].ids.tolist() == [0, 87]
    assert survey.corners["one"].pixels_px.tolist() == [[400.5, 300.25], [500.5, 380.25]]
    assert survey.corners["one"].sigma_px.tolist() == [0.1, 0.1]
    assert set(survey.corners) == {"one", "two"}
    modes = [camera.sensor_mode for camera in survey.cameras.values()]
    assert modes == [SensorMode((1024, 768), flip=(True, True)), None]


def test_columns_stand_in_any_order_and_a_corner_may_have_its_own_sigma(tmp_path: Path) -> None:
    images = "file,image,setup,camera,board,placement,purpose,tilt_rad,pan_rad\n"
    images += ",a,s,navcam_left,wall,p,mast,0.1,0.2\n"
    corners = "image,id,board,sigma_px,x_px,y_px\na,3,wall,0.02,10,20\na,4,wall,,30,20\n"
    survey = read_survey(folder_of(tmp_path, images=images, corners=corners))
    assert (survey.images[0].pan_rad, survey.images[0].tilt_rad, survey.images[0].setup) == (0.2, 0.1, "s")
    assert survey.corners["a"].sigma_px.tolist() == [0.02, 0.1]


CASES = {
    "no board": ("yaml", "boards:", "boards: {}\nx:", "x: unknown key"),
    "bad board": ("yaml", "marker_m: 0.015", "marker_m: 0.03", "boards.wall.marker_m: 0.03 where less"),
    "no sigma": ("yaml", "corner_px: 0.1, ", "", "sigma.corner_px: the key is missing"),
    "a surveyed board too": ("yaml", "boards:", "board: {}\nboards:", "board: unknown key"),
    "other board": ("images", "wall,check", "wal,check", "line 4, board: 'wal' is no board of survey.yaml"),
    "approach": ("images", ",1,-1,", ",2,-1,", "line 2, pan_approach: 2 where"),
    "half an approach": ("images", ",1,-1,", ",0.5,-1,", "line 2, pan_approach: 0.5 where -1, 0 or 1"),
    "approach of a body camera": (
        "images",
        "camera,,,,,",
        "camera,,,1,,",
        "line 3, pan_approach: '1' where nothing",
    ),
    "unknown column": ("images", "pan_approach", "pan_aproach", "nearest known is 'pan_approach'"),
    "column missing": ("images", "purpose,", "", "there is no column purpose"),
    "column twice": ("images", "pan_approach", "tilt_approach", "column tilt_approach is there twice"),
    "separated by ;": ("images", ",", ";", "line 1: the header is 'image;camera"),
    "another board's corner": (
        "corners",
        "two,desk",
        "two,wall",
        "'wall' where image two of images.csv shows desk",
    ),
    "no such corner": ("corners", "wall,87", "wall,88", "line 3, id: 88 where an integer from 0 to 87"),
    "corner twice": ("corners", "wall,87", "wall,0", "corner 0 of image one is there twice"),
    "outside": ("corners", "100,200", "700,200", "line 4, x_px: 700 is outside the image of hazcam_left"),
}


@pytest.mark.parametrize("case", CASES)
def test_what_is_wrong_is_refused_with_its_place(tmp_path: Path, case: str) -> None:
    which, old, new, expected = CASES[case]
    texts = {"yaml": YAML, "images": IMAGES, "corners": CORNERS}
    assert old in texts[which]
    texts[which] = texts[which].replace(old, new)
    with pytest.raises(BadFile) as error:
        read_survey(folder_of(tmp_path, **texts))
    assert expected in str(error.value)


def test_a_station_does_not_go_with_boards(tmp_path: Path) -> None:
    (folder_of(tmp_path) / "station.csv").write_text("setup,kind,placement,point,x_m,y_m,z_m\n")
    with pytest.raises(BadFile, match="goes with a station"):
        read_survey(tmp_path)


def test_what_is_written_at_once_is_read_back_to_the_last_bit(tmp_path: Path) -> None:
    survey = read_survey(folder_of(tmp_path / "a"))
    again = write_survey(survey, tmp_path / "b")
    assert again.boards == survey.boards
    assert [vars(i) for i in again.images] == [vars(i) for i in survey.images]
    for name, corners in survey.corners.items():
        assert np.array_equal(again.corners[name].pixels_px, corners.pixels_px)


CAMERA = SurveyCamera("navcam_left", "head", (1024, 768), "CAHVOR", 1290.0)
BOARD = Charuco(9, 12, 0.02, 0.015)


def grown(path: Path) -> BenchFolder:
    return BenchFolder(path, {"wall": BOARD}, Sigma(0, 0, corner_px=0.1), {CAMERA.name: CAMERA}, {})


def image(name: str) -> SurveyImage:
    return SurveyImage(name, CAMERA.name, "", "p1", "mast", 0.1, 0.2, Path(f"{name}.png"), 0, "wall", 1, -1)


def corners_at(x_px: float) -> Corners:
    pixels = np.stack([x_px + np.arange(88) / 7, 100 + np.arange(88) / 3], axis=-1)
    return Corners(BOARD.ids, pixels, np.full(88, 0.02))


def test_a_folder_grows_by_images_and_goes_on_after_a_new_start(tmp_path: Path) -> None:
    bench = grown(tmp_path / "bench")
    assert bench.survey().images == ()
    bench.append(image("a"), corners_at(10.0), b"not looked at")
    bench.append(image("b"), None)
    again = grown(tmp_path / "bench")
    again.append(image("c"), corners_at(30.0))
    survey = again.survey()
    assert [(i.name, i.row, i.pan_approach) for i in survey.images] == [("a", 2, 1), ("b", 3, 1), ("c", 4, 1)]
    assert set(survey.corners) == {"a", "c"}
    assert np.array_equal(survey.corners["c"].pixels_px, corners_at(30.0).pixels_px)
    with pytest.raises(BadFile, match="has an image a already"):
        again.append(image("a"), None)


def test_a_folder_of_another_bench_is_not_gone_on_with(tmp_path: Path) -> None:
    grown(tmp_path)
    with pytest.raises(BadFile, match="another folder"):
        BenchFolder(tmp_path, {"wall": BOARD}, Sigma(0, 0, corner_px=0.2), {CAMERA.name: CAMERA}, {})


def test_a_folder_does_not_go_on_in_another_sensor_mode(tmp_path: Path) -> None:
    def begun(name: str, mode: SensorMode | None) -> BenchFolder:
        camera, path = replace(CAMERA, sensor_mode=mode), tmp_path / name
        return BenchFolder(path, {"wall": BOARD}, Sigma(0, 0, corner_px=0.1), {CAMERA.name: camera}, {})

    plain, flipped = SensorMode((1024, 768)), SensorMode((1024, 768), flip=(True, False))
    begun("unknown", None)
    assert begun("unknown", flipped).survey().cameras[CAMERA.name].sensor_mode is None
    begun("known", plain)
    assert begun("known", None).survey().cameras[CAMERA.name].sensor_mode == plain
    with pytest.raises(BadFile, match="another folder"):
        begun("known", flipped)


class Killed(BaseException):
    """The process is no more."""


@pytest.mark.parametrize("steps", range(6))
def test_a_kill_leaves_images_with_all_corners_or_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, steps: int
) -> None:
    bench = grown(tmp_path)
    bench.append(image("a"), corners_at(10.0), b"picture")
    left = [steps]
    truly = bench_writer.replace_bytes  # type: ignore[attr-defined]

    def until_killed(path: Path, data: bytes, mode: int = 0o600) -> None:
        if left[0] == 0:
            path.with_name(f".{path.name}.new").write_bytes(data[: len(data) // 2])
            raise Killed
        left[0] -= 1
        truly(path, data, mode)

    monkeypatch.setattr(bench_writer, "replace_bytes", until_killed)
    with pytest.raises(Killed):
        bench.append(image("b"), corners_at(20.0), b"picture")
        bench.append(image("c"), corners_at(30.0), b"picture")
        raise Killed
    monkeypatch.undo()
    survey = grown(tmp_path).survey()
    assert "a" in survey.corners
    for one in survey.images:
        assert (tmp_path / one.file).is_file()
        assert one.name not in survey.corners or len(survey.corners[one.name]) == len(BOARD.ids)


def test_the_check_says_what_a_bench_lacks(tmp_path: Path) -> None:
    expected = "\n".join(map(str, check_survey(read_survey(folder_of(tmp_path)))))
    assert "images.csv line 4, camera navcam_left: 1 of 2 images have neither corners" in expected
    assert "stood in one place only" in expected
    empty = "\n".join(map(str, check_survey(read_survey(folder_of(tmp_path / "e", images="", corners="")))))
    assert "camera navcam_left: it has no image" in empty


def test_angles_in_degrees_are_an_error_of_a_bench_too(tmp_path: Path) -> None:
    survey = read_survey(folder_of(tmp_path, images=IMAGES.replace("0.5,-0.2", "30,-0.2")))
    assert any("write radians" in finding.advice for finding in check_survey(survey))
