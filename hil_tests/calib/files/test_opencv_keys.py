"""Mast files with cameras of OpenCV's families: read, written, refused."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from calib.errors import BadFile
from calib.files.mast_file import load_rig, save_rig
from calib.geometry.rigid import Rigid, rot_x

TEXT = """schema: mastctl/mast/1
name: bench
mast: {translation_m: [0.33, 0.0, -1.32], rotation_rad: [-0.0088, -0.0181, 0.0005]}
cameras:
  navcam:
    on: head
    size_px: [1280, 720]
    model: OPENCV8
    camera_matrix: [[600.0, 0.0, 640.0], [0.0, 610.0, 350.0], [0.0, 0.0, 1.0]]
    distortion: [0.5, 0.1, 0.001, -0.0005, 0.01, 0.8, 0.2, 0.03]
    rotation: [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]
    C: [0.05, -0.1, -0.1]
"""


def written(tmp_path: Path, text: str) -> Path:
    (tmp_path / "mast.yaml").write_text(text)
    return tmp_path / "mast.yaml"


def test_the_keys_are_opencvs_numbers(tmp_path: Path) -> None:
    model = load_rig(written(tmp_path, TEXT)).rig.cameras["navcam"].model
    point = np.array([[2.0, 0.3, 0.4]])
    rotation = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    theirs = cv2.projectPoints(
        point,
        cv2.Rodrigues(rotation)[0],
        -rotation @ [0.05, -0.1, -0.1],
        np.array([[600.0, 0.0, 640.0], [0.0, 610.0, 350.0], [0.0, 0.0, 1.0]]),
        np.array([0.5, 0.1, 0.001, -0.0005, 0.01, 0.8, 0.2, 0.03]),
    )[0]
    np.testing.assert_allclose(model.project(point)[0], theirs.reshape(1, 2), atol=1e-9)


def test_a_file_read_and_written_is_the_same_to_the_last_bit(tmp_path: Path) -> None:
    first = save_rig(load_rig(written(tmp_path, TEXT)).rig, tmp_path / "one.yaml")
    turned = first.rig.cameras["navcam"].model.moved(Rigid(rot_x(0.3), np.zeros(3)))
    assert np.abs(turned.rotation @ turned.rotation.T - np.eye(3)).max() < 1e-15
    assert save_rig(load_rig(tmp_path / "one.yaml").rig, tmp_path / "two.yaml").digest == first.digest


@pytest.mark.parametrize(
    ("old", "new", "phrase"),
    [
        ("OPENCV8", "OPENCV9", "cameras.navcam.model: the text 'OPENCV9' where one of CAHV, CAHVOR, CAHVO"),
        (
            "OPENCV8",
            "OPENCV5",
            "cameras.navcam.distortion: a list of 8 where a list of 5 numbers is expected",
        ),
        ("    distortion:", "    R:", "cameras.navcam.R: OPENCV8 has no 'R'; another 'model' has it"),
        ("    rotation: [[0.0, 1.0, 0.0], ", "    rotation: [[0.5, 1.0, 0.0], ", "a rotation is expected"),
        ("[0.0, 610.0, 350.0]", "[5.0, 610.0, 350.0]", "[[fx, skew, cx], [0, fy, cy], [0, 0, 1]]"),
        (
            "[0.0, 610.0, 350.0]",
            "[0.0, 610.0]",
            "cameras.navcam.camera_matrix[1]: a list of 2 where a list of 3 numbers",
        ),
        ("    C: [0.05, -0.1, -0.1]\n", "", "cameras.navcam.C: the key is missing"),
        ("OPENCV8", "CAHVOR", "cameras.navcam.camera_matrix: CAHVOR has no 'camera_matrix'"),
        ("[0.5, 0.1,", "[0.5, .nan,", "finite"),
    ],
)
def test_what_is_no_such_camera_is_refused_by_key(old: str, new: str, phrase: str, tmp_path: Path) -> None:
    with pytest.raises(BadFile) as refused:
        load_rig(written(tmp_path, TEXT.replace(old, new, 1)))
    assert phrase in str(refused.value)


def test_a_lens_that_sees_hardly_any_of_its_image_is_refused(tmp_path: Path) -> None:
    numbers = "[0.5, 0.1, 0.001, -0.0005, 0.01, 0.8, 0.2, 0.03]"
    narrow = TEXT.replace("OPENCV8", "OPENCV4")
    with pytest.raises(BadFile) as refused:
        load_rig(written(tmp_path, narrow.replace(numbers, "[-1100.0, 0.0, 0.0, 0.0]")))
    assert "cameras.navcam: 100 %, more than half of the image has no ray" in str(refused.value)
    assert "the lens folds at 1.0 degrees from its axis" in str(refused.value)
    (note,) = load_rig(written(tmp_path, narrow.replace(numbers, "[-0.2, 0.0, 0.0, 0.0]"))).notes
    assert re.fullmatch(
        r"cameras.navcam: [0-9.]+ % of the image has no ray: the lens folds at 52.2 degrees .*", note
    )
