"""Files as OpenCV, ROS, Kalibr and mrcal really write them: read as cv2 reads them, or refused.

cv2.projectPoints and cv2.fisheye.projectPoints say where a point falls; cv2.FileStorage writes the files.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from calib.errors import BadFile
from calib.files import CameraFile
from calib.files.any_camera import load_any

EXACT_PX = 1e-9
MATRIX = np.array([[300.0, 0, 320], [0, 300, 240], [0, 0, 1]])
FOUR = [-0.02, 0.01, -0.008, 0.002]
POINT = np.array([[1.0, 0.75, 1.0]])
SIZE = "image_width: 640\nimage_height: 480\n"
K_ROW = "[300, 0, 320, 0, 300, 240, 0, 0, 1]"
K_LINE = f"camera_matrix: {{rows: 3, cols: 3, data: {K_ROW}}}\n"
LENSES = {
    5: [-0.2, 0.05, 0.001, -0.0007, 0.02],
    8: [0.3, 0.05, 0.001, -0.0007, 0.002, 0.5, 0.1, 0.005],
    12: [-0.2, 0.05, 0.001, -0.0007, 0.02, 0.0, 0.0, 0.0, 0.001, 0.0002, -0.001, 0.0003],
    14: [-0.2, 0.05, 0.001, -0.0007, 0.02, 0.0, 0.0, 0.0, 0.001, 0.0002, -0.001, 0.0003, 0.01, -0.02],
}


def pinhole_px(coefficients: list[float], matrix: np.ndarray = MATRIX) -> np.ndarray:
    return cv2.projectPoints(POINT, np.zeros(3), np.zeros(3), matrix, np.array(coefficients))[0][0]


def fisheye_px(coefficients: list[float]) -> np.ndarray:
    return cv2.fisheye.projectPoints(POINT[None], np.zeros(3), np.zeros(3), MATRIX, np.array(coefficients))[
        0
    ][0]


def read(tmp_path: Path, text: str | bytes, name: str = "camera.yaml") -> CameraFile:
    (tmp_path / name).write_bytes(text if isinstance(text, bytes) else text.encode())
    found = load_any(tmp_path / name)
    assert isinstance(found, CameraFile)
    return found


def seen_px(camera: CameraFile) -> np.ndarray:
    return camera.model.project(POINT)[0]


def refusal(tmp_path: Path, text: str, name: str = "camera.yaml") -> str:
    with pytest.raises(BadFile) as refused:
        read(tmp_path, text, name)
    return str(refused.value)


def storage(suffix: str, tmp_path: Path, **values: Any) -> Path:
    path = tmp_path / f"cv{suffix}"
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for key, value in values.items():
        file.write(key, value)
    file.release()
    return path


def coefficients(numbers: list[float], columns: int | None = None) -> str:
    columns = len(numbers) if columns is None else columns
    return f"distortion_coefficients: {{rows: 1, cols: {columns}, data: {numbers}}}\n"


# Keys that change the meaning.


def test_a_fisheye_beside_the_coefficients_is_refused_with_the_way_out(tmp_path: Path) -> None:
    text = SIZE + K_LINE + coefficients(FOUR)
    beside = text + f"fisheye_distortion: {{rows: 1, cols: 4, data: {FOUR}}}\n"
    message = refusal(tmp_path, beside)
    assert "fisheye_distortion: this key may change the lens" in message
    assert "distortion_model" in message and "equidistant" in message
    camera = read(tmp_path, text + "distortion_model: equidistant\n")
    np.testing.assert_allclose(
        seen_px(camera), [[532.3, 399.2]], atol=0.05
    )  # as the report of the fault says
    np.testing.assert_allclose(seen_px(camera), fisheye_px(FOUR), atol=EXACT_PX)


@pytest.mark.parametrize(
    ("line", "phrase"),
    [
        ("xi: 1.2", "xi: this key may change the lens"),
        ("lens_type: omni", "lens_type: this key may change the lens"),
        ("skew: 0.1", "skew: this key may change the lens"),
        ("distortion_modle: equidistant", "the nearest known is 'distortion_model'"),
        ("fisheye_modell: 1", "the nearest known is 'fisheye_model'"),
        ("camera_model: omni", "where one of plumb_bob"),
        ("camera_model: fisheye\ndistortion_model: plumb_bob", "name two lenses"),
        ("fisheye_model: 1\ndistortion_model: plumb_bob", "name two lenses"),
        ("distortion_model: none", "4 coefficients, and distortion_model 'none'"),
        ("dist_coeffs: [1, 2, 3, 4]", "dist_coeffs: has other values than 'distortion_coefficients'"),
        ("binning_x: 2", "binning_x: the picture is binned"),
    ],
)
def test_a_key_that_may_change_the_lens_is_never_only_noted(line: str, phrase: str, tmp_path: Path) -> None:
    text = SIZE + K_LINE + coefficients(FOUR)
    assert phrase in refusal(tmp_path, f"{text}{line}\n")
    assert phrase in refusal(tmp_path, f"%YAML:1.0\n---\n{text}{line}\n")


def test_a_pinhole_projection_with_a_named_lens_has_that_lens(tmp_path: Path) -> None:
    text = SIZE + K_LINE + coefficients(FOUR) + "camera_model: pinhole\n"
    np.testing.assert_allclose(seen_px(read(tmp_path, text)), pinhole_px(FOUR)[None][0], atol=EXACT_PX)
    named = read(tmp_path, text + "distortion_model: equidistant\n")
    np.testing.assert_allclose(seen_px(named), fisheye_px(FOUR), atol=EXACT_PX)


@pytest.mark.parametrize("line", ["distortion_coefficients_std_dev: [1, 2]", "nframes: 12", "flags: 0"])
def test_what_says_nothing_of_the_lens_is_noted(line: str, tmp_path: Path) -> None:
    camera = read(tmp_path, SIZE + K_LINE + coefficients(FOUR) + line + "\n")
    assert camera.notes == (f"{line.split(':')[0]} not read",)


def test_a_lens_of_kalibr_without_distortion_has_no_coefficients(tmp_path: Path) -> None:
    text = CHAIN.replace("distortion_model: radtan", "distortion_model: none")
    assert "distortion_coeffs: 4 coefficients, and distortion_model 'none'" in refusal(tmp_path, text)


# Names of lenses and numbers of coefficients.


@pytest.mark.parametrize("name", ["plumb_bob", "rational_polynomial"])
@pytest.mark.parametrize("count", LENSES)
def test_the_number_of_coefficients_decides_as_in_cv2(name: str, count: int, tmp_path: Path) -> None:
    camera = read(tmp_path, SIZE + K_LINE + f"distortion_model: {name}\n" + coefficients(LENSES[count]))
    np.testing.assert_allclose(seen_px(camera), pinhole_px(LENSES[count]), atol=EXACT_PX)


def test_the_numbers_count_more_than_rows_and_cols(tmp_path: Path) -> None:
    text = SIZE + K_LINE + "distortion_model: plumb_bob\n" + coefficients(LENSES[8], columns=5)
    np.testing.assert_allclose(seen_px(read(tmp_path, text)), pinhole_px(LENSES[8]), atol=EXACT_PX)


@pytest.mark.parametrize("numbers", [FOUR, [*FOUR, 0.0], []])
def test_an_equidistant_lens_has_four_coefficients(numbers: list[float], tmp_path: Path) -> None:
    text = SIZE + K_LINE + "distortion_model: equidistant\n"
    camera = read(tmp_path, text + coefficients(numbers))
    np.testing.assert_allclose(seen_px(camera), fisheye_px(numbers[:4] or [0.0] * 4), atol=EXACT_PX)
    assert "5 coefficients where 4 are expected" in refusal(tmp_path, text + coefficients([*FOUR, 0.1]))
    assert "3 coefficients where 4 are expected" in refusal(tmp_path, text + coefficients(FOUR[:3]))


@pytest.mark.parametrize("empty", ["{rows: 0, cols: 0, data: []}", "{rows: 1, cols: 5, data: []}", "[]"])
def test_an_empty_list_is_a_lens_without_distortion(empty: str, tmp_path: Path) -> None:
    camera = read(tmp_path, SIZE + K_LINE + f"distortion_coefficients: {empty}\n")
    np.testing.assert_allclose(seen_px(camera), pinhole_px([]), atol=EXACT_PX)


def test_a_lens_under_camera_model_is_that_lens(tmp_path: Path) -> None:
    camera = read(tmp_path, SIZE + K_LINE + coefficients(LENSES[5]) + "camera_model: plumb_bob\n")
    np.testing.assert_allclose(seen_px(camera), pinhole_px(LENSES[5]), atol=EXACT_PX)


# OpenCV's own files.


@pytest.mark.parametrize("suffix", [".yml", ".xml", ".json"])
def test_each_form_of_opencvs_storage_is_read(suffix: str, tmp_path: Path) -> None:
    path = storage(
        suffix,
        tmp_path,
        calibration_time="Bob's \\ today",
        image_width=640,
        image_height=480,
        camera_matrix=MATRIX,
        distortion_coefficients=np.array([LENSES[5]]).T,
        image_points=np.zeros((40, 88)),
    )
    camera = load_any(path)
    assert isinstance(camera, CameraFile)
    np.testing.assert_allclose(seen_px(camera), pinhole_px(LENSES[5]), atol=EXACT_PX)
    assert camera.notes == ("calibration_time, image_points not read",)


@pytest.mark.parametrize(
    "head",
    [
        *(
            "%YAML:1.0\n",
            "%YAML:1.0 # by me\n---\n",
            "# mine\n\n%YAML:1.0\n# more\n---\n",
            "%YAML 1.0\n---\n",
        ),
        "\ufeff%YAML:1.0\n---\n",
    ],
)
def test_a_head_with_comments_is_read(head: str, tmp_path: Path) -> None:
    text = (
        f"{head}{SIZE}dist_coeff: !!opencv-matrix\n   rows: 1\n   cols: 5\n"
        f"   dt: d\n   data: {LENSES[5]}\ncamera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n"
        f"   data: {K_ROW}\n"
    )
    np.testing.assert_allclose(seen_px(read(tmp_path, text)), pinhole_px(LENSES[5]), atol=EXACT_PX)


@pytest.mark.parametrize(
    ("text", "phrase"),
    [
        ("%YAML:1.0\n---\na: [1, 2\nb: 1\n", "line 4: is not YAML"),
        ('<?xml version="1.0"?>\n<opencv_storage>\n<a>1</a><b>\n', "line 4: is not XML"),
        ('<?xml version="1.0"?>\n<html><body>1</body></html>\n', "<html> where <opencv_storage> is expected"),
        ("%YAML:1.0\n---\na: " + "[" * 200_000, "is nested deeper than 16 levels"),
        ('<?xml version="1.0"?>\n<opencv_storage>' + "<a>" * 200_000, "is not XML"),
        (f"<opencv_storage>{'<a>' * 99_999}1{'</a>' * 99_999}</opencv_storage>", "deeper than 16 levels"),
        ("<opencv_storage><K>1</K><K>1</K></opencv_storage>", "K: the key is there twice"),
        ("%YAML:1.0\n---\na: !!binary |\n   abcd\n", "line 3: tag tag:yaml.org,2002:binary; plain values"),
        (f"%YAML:1.0\n---\n{SIZE}{K_LINE}{K_LINE}", "camera_matrix: the key is there twice"),
    ],
)
def test_a_broken_storage_is_refused_in_one_line(
    text: str, phrase: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert phrase in refusal(tmp_path, text, "camera.xml")
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize(
    ("old", "new", "phrase"),
    [
        ("camera_matrix", "camera_matirx", "camera_matrix: the key is missing; rename 'camera_matirx'"),
        ("distortion_coef", "distorsion_coef", "the key is missing; rename 'distorsion_coefficients'"),
        ("image_width", "image_widht", "image_width: the key is missing; rename 'image_widht'"),
        ("image_width: 640\n", "", "add the image's size in pixels, as 'image_width: 640'"),
    ],
)
def test_a_misspelled_key_gets_the_nearest_known_one(old: str, new: str, phrase: str, tmp_path: Path) -> None:
    text = (SIZE + K_LINE + coefficients(LENSES[5])).replace(old, new)
    assert phrase in refusal(tmp_path, text)


# ROS.

MESSAGE = (
    "header:\n  stamp: {sec: %d, nanosec: 2}\n  frame_id: left\nheight: 480\nwidth: 640\n"
    "distortion_model: plumb_bob\nd: [-0.2, 0.05, 0.001, -0.0007, %g]\n"
    f"k: {K_ROW}\nr: [1, 0, 0, 0, 1, 0, 0, 0, 1]\nbinning_x: 0\nbinning_y: 0\n"
    "p: [300, 0, 320, 0, 0, 300, 240, 0, 0, 0, 1, 0]\nroi: {x_offset: 0, do_rectify: false}\n---\n"
)


def test_of_messages_of_one_topic_the_first_is_read(tmp_path: Path) -> None:
    camera = read(tmp_path, MESSAGE % (1, 0.02) + (MESSAGE % (2, 0.02))[:150])
    np.testing.assert_allclose(seen_px(camera), pinhole_px(LENSES[5]), atol=EXACT_PX)
    assert camera.notes == ()


# Kalibr and mrcal.

CHAIN = """cam0:
  camera_model: pinhole
  intrinsics: [300, 300, 320, 240]
  distortion_model: radtan
  distortion_coeffs: [-0.02, 0.01, -0.008, 0.002]
  resolution: [640, 480]
cam1:
  camera_model: pinhole
  intrinsics: [300, 300, 320, 240]
  distortion_model: radtan
  distortion_coeffs: [-0.02, 0.01, -0.008, 0.002]
  resolution: [640, 480]
  T_cn_cnm1: [[1, 0, 0, -0.1], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
cam2:
  camera_model: pinhole
  intrinsics: [300, 300, 320, 240]
  distortion_model: equidistant
  distortion_coeffs: [-0.02, 0.01, -0.008, 0.002]
  resolution: [640, 480]
  T_cn_cnm1: [[1, 0, 0, -0.2], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
imu0: {rate_hz: 200}
"""


def test_a_chain_is_followed_from_camera_to_camera(tmp_path: Path) -> None:
    (tmp_path / "chain.yaml").write_text(CHAIN)
    found = load_any(tmp_path / "chain.yaml")
    assert isinstance(found, dict)
    np.testing.assert_allclose(seen_px(found["cam0"]), pinhole_px(FOUR), atol=EXACT_PX)
    np.testing.assert_allclose(found["cam2"].model.C, [0.3, 0.0, 0.0], atol=1e-12)
    assert found["cam0"].notes == ("imu0 not read",)
    no_turn = CHAIN.replace("T_cn_cnm1: [[1, 0, 0, -0.1]", "T_cn_cnm1: [[2, 0, 0, -0.1]")
    assert "cam1.T_cn_cnm1: no rotation" in refusal(tmp_path, no_turn)


@pytest.mark.parametrize(
    ("lens", "pose"),
    [
        ("'lensmodel': 'LENSMODEL_", ("extrinsics",)),
        ("'lens_model': 'LENSMODEL_", ("extrinsics",)),
        ("'distortion_model': 'DISTORTION_", ("extrinsics",)),
        ("'lensmodel': 'LENSMODEL_", ("rt_cam_ref",)),
        ("'lensmodel': 'LENSMODEL_", ("rt_cam_ref", "extrinsics")),
    ],
)
def test_mrcals_keys_of_every_release_are_read(lens: str, pose: tuple[str, ...], tmp_path: Path) -> None:
    poses = "".join(f"    '{key}': [ 0, 0, 0, 1, 0, 0,],\n" for key in pose)
    numbers = ", ".join(map(str, [300, 300, 320, 240, *LENSES[8]]))
    text = f"{{\n    {lens}OPENCV8',\n    'intrinsics': [ {numbers},],\n{poses}"
    text += "    'imagersize': [ 640, 480,],\n}\n"
    camera = read(tmp_path, text, "a.cameramodel")
    np.testing.assert_allclose(
        camera.model.project(POINT - [1, 0, 0])[0], pinhole_px(LENSES[8]), atol=EXACT_PX
    )
    assert camera.notes == ()
    if len(pose) == 2:
        with_other = text.replace("'extrinsics': [ 0, 0", "'extrinsics': [ 0, 1")
        assert "extrinsics: has other values than 'rt_cam_ref'" in refusal(
            tmp_path, with_other, "a.cameramodel"
        )


# Files of other programs.


@pytest.mark.parametrize(
    "text", ["services:\n  web: {image: nginx}\n", "width: 3\nheight: 4\n", '{"a": 1}\n']
)
def test_a_yaml_file_of_another_program_is_none_of_the_formats(text: str, tmp_path: Path) -> None:
    assert "is not one of these formats: a mast file, " in refusal(tmp_path, text)


def test_a_mast_file_without_its_schema_is_still_named_one(tmp_path: Path) -> None:
    text = "name: bench\nmast: {translation_m: [0, 0, 0]}\ncameras: {}\n"
    assert "schema: the key is missing" in refusal(tmp_path, text)


@pytest.mark.parametrize("name", ["dump.yaml", "dump.json"])
def test_lists_that_python_dumped_are_read(name: str, tmp_path: Path) -> None:
    import json

    data = {"camera_matrix": MATRIX.tolist(), "dist_coeff": [LENSES[5]], "image_width": 640.0}
    camera = read(tmp_path, json.dumps(data | {"image_height": 480}), name)
    np.testing.assert_allclose(seen_px(camera), pinhole_px(LENSES[5]), atol=EXACT_PX)
    text = json.dumps(data | {"image_height": 480, "camera_matrix": str(MATRIX).replace("\n", " ")})
    assert "where {rows, cols, data} or [[a, b, c], ...] is expected" in refusal(tmp_path, text, name)


def test_an_array_that_python_pickled_gets_the_needed_form(tmp_path: Path) -> None:
    text = SIZE + "camera_matrix: !!python/object/apply:numpy.core.multiarray._reconstruct\n  args: [1]\n"
    assert "write array.tolist()" in refusal(tmp_path, text)


@pytest.mark.parametrize(
    ("line", "phrase"),
    [
        ("Modle = CAHVORE3,0.4", "unknown key 'Modle ='; the nearest known is 'Model ='"),
        ("model = CAHV", "the nearest known is 'Model ='"),
        ("P = 0.4", "unknown key 'P ='; known are Model"),
    ],
)
def test_a_key_of_a_cahvor_file_that_may_change_it_is_refused(line: str, phrase: str, tmp_path: Path) -> None:
    text = (
        "Dimensions = 640 480\nC = 0 0 0\nA = 0 0 1\nH = 300 0 320\nV = 0 300 240\nO = 0 0 1\nR = 0 -0.1 0\n"
    )
    assert phrase in refusal(tmp_path, f"{line}\n{text}", "a.cahvor")
    noted = read(tmp_path, f"Comment = by hand\n{text}", "a.cahvor")
    assert noted.notes == ("line 1, 'Comment =', is not read",)
