"""Cameras of OpenCV, ROS, Kalibr and mrcal: read, written, and what a conversion costs.

``mrcal_vectors.json`` holds what mrcal itself wrote and projected, and what it made of files that this writer
wrote; how it was made stands in it.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml

from calib.errors import BadFile
from calib.files import CameraFile
from calib.files.any_camera import load_any, nearest_lens, save_any
from calib.files.mast_file import load_rig
from calib.files.mrcal_kalibr import format_mrcal, parse_mrcal
from calib.files.twin import twin_error
from hil_tests.calib.geometry.camera_cases import plain

MAST = Path(__file__).parents[3] / "configs" / "masts" / "rocky8_simulated.yaml"
VECTORS = json.loads((Path(__file__).parent / "mrcal_vectors.json").read_text())
MRCAL_PX = 1e-6
OTHERS = ("opencv", "ros", "kalibr", "mrcal")
HELD_POSE = ("opencv", "kalibr", "mrcal")

INFO = """image_width: 640
image_height: 480
camera_name: left
camera_matrix: {rows: 3, cols: 3, data: [600, 0, 319, 0, 601, 241, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [-0.31, 0.12, 0.001, -0.0007, 0.02]}
rectification_matrix: {rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}
projection_matrix: {rows: 3, cols: 4, data: [600, 0, 319, 0, 0, 601, 241, 0, 0, 0, 1, 0]}
"""
CHAIN = """cam0:
  camera_model: pinhole
  intrinsics: [461.6, 460.2, 362.7, 246.0]
  distortion_model: radtan
  distortion_coeffs: [-0.277, 0.067, 0.0009, 0.0001]
  resolution: [752, 480]
  rostopic: /cam0/image_raw
cam1:
  camera_model: pinhole
  intrinsics: [250.0, 250.5, 373.9, 253.7]
  distortion_model: equidistant
  distortion_coeffs: [-0.03, 0.012, -0.004, 0.0006]
  resolution: [752, 480]
  T_cn_cnm1:
  - [0, 0, 1, -0.11]
  - [0, 1, 0, 0.002]
  - [-1, 0, 0, 0.003]
  - [0, 0, 0, 1]
"""
MODEL = """# generated
{
    'lensmodel':  'LENSMODEL_CAHVOR',
    'intrinsics': [ 1226.5, 1227.25, 512.25, 380.5, 0.0087, -0.0042, 0.0, -0.11, 0.05,],
    'extrinsics': [ 0.1, 0.2, -0.3, 1, 2, 3,],
    'imagersize': [ 1024, 768,],
    'optimization_inputs': b'P)h>@6aWA{K2;]}#',
}
"""
OPENCV = """%YAML:1.0
---
calibration_time: "today"
image_width: 640
image_height: 480
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 600., 0., 319., 0., 601., 241., 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 5
   cols: 1
   dt: d
   data: [ -3.1e-01, 1.2e-01, 1.e-03, -7.e-04, 2.e-02 ]
"""
TEXTS = {
    "info.yaml": INFO,
    "chain.yaml": CHAIN,
    "a.cameramodel": MODEL,
    "cv.yml": OPENCV,
}


def reference(name: str) -> CameraFile:
    camera = load_rig(MAST).rig.cameras[name]
    return CameraFile(camera.model, camera.on)


def read(tmp_path: Path, name: str, text: str) -> Any:
    (tmp_path / name).write_text(text)
    return load_any(tmp_path / name)


@pytest.mark.parametrize("case", VECTORS["cameras"], ids=lambda case: case["name"])
def test_a_camera_of_mrcal_projects_as_mrcal_does(case: dict[str, Any]) -> None:
    camera = parse_mrcal(case["text"].encode(), "x.cameramodel").model
    pixels, valid = camera.project(np.array(case["points_m"]))
    assert valid.all()
    np.testing.assert_allclose(pixels, case["pixels_px"], atol=MRCAL_PX)


@pytest.mark.parametrize("case", VECTORS["lenses"], ids=lambda case: case["name"])
def test_a_lens_of_mrcal_is_kept_as_it_is_in_every_file(case: dict[str, Any], tmp_path: Path) -> None:
    camera = parse_mrcal(case["text"].encode(), "x.cameramodel")
    assert case["name"].startswith(camera.model.kind)
    pixels = np.array(case["pixels_px"])
    np.testing.assert_allclose(camera.model.project(np.array(case["points_m"]))[0], pixels, atol=1e-9)
    for name in ("x.yaml", "y.cameramodel"):
        assert save_any(camera, tmp_path / name).worst_px < 1e-9
        again = load_any(tmp_path / name)
        assert isinstance(again, CameraFile) and again.model.kind == camera.model.kind
        rays = again.model.ray(pixels)
        assert rays.valid.all()
        seen, _ = camera.model.project(rays.origins_m + 5.0 * rays.directions)
        np.testing.assert_allclose(seen, pixels, atol=1e-9)


@pytest.mark.parametrize("case", VECTORS["written"], ids=lambda case: case["camera"] + case["lens"])
def test_mrcal_reads_what_is_written_for_it(case: dict[str, Any], tmp_path: Path) -> None:
    """The numbers of the text may differ in the last digit; what they project to may not."""
    original = reference(case["camera"])
    done = save_any({case["camera"]: original}, tmp_path / "x.cameramodel", lens=case["lens"], limit_px=1.0)
    now = load_any(tmp_path / "x.cameramodel").model  # type: ignore[union-attr]
    points, pixels = np.array(case["points_m"]), np.array(case["pixels_px"])
    np.testing.assert_allclose(now.project(points)[0], pixels, atol=1e-4)
    off = np.linalg.norm(original.model.project(points)[0] - pixels, axis=1)
    assert off.max() <= done.worst_px
    assert (tmp_path / "x.cameramodel").read_text().split("'intrinsics'")[0] == case["text"].split(
        "'intrinsics'"
    )[0]


@pytest.mark.parametrize("to", OTHERS)
@pytest.mark.parametrize("name", ["pancam_left", "navcam_left", "hazcam_left"])
def test_the_error_that_a_conversion_states_is_the_error_of_its_file(
    to: str, name: str, tmp_path: Path
) -> None:
    original = reference(name)
    path = tmp_path / f"x.{to}.txt"
    done = save_any({name: original}, path, limit_px=5.0)
    again = load_any(path)
    assert isinstance(again, CameraFile)
    twin = again.model
    if to not in HELD_POSE:  # both in their own axes then: the rotation was reported, not written
        rows = done.lost[0].split("columns of ")[1]
        place = done.lost[0].split("at [")[1].split("] m")[0]
        from calib.geometry.rigid import Rigid

        turn, _, other = np.linalg.svd(np.array(json.loads(rows)))
        pose = Rigid(turn @ other, np.array(json.loads(f"[{place}]")))
        twin = twin.moved(pose)
    rng = np.random.default_rng(5)
    pixels = rng.uniform([-0.5, -0.5], np.array(original.model.size_px) - 0.5, (2000, 2))
    rays = original.model.ray(pixels)
    off = np.zeros(len(pixels))
    for range_m in (1.0, 100.0):
        seen, valid = twin.project(rays.origins_m + range_m * rays.directions)
        assert valid.all()
        off = np.maximum(off, np.linalg.norm(seen - pixels, axis=1))
    assert 0.6 * done.worst_px <= off.max() <= 1.02 * done.worst_px + 1e-5
    assert again.model.kind[:5] == ("CAHVO" if to == "mrcal" else "OPENC")


@pytest.mark.parametrize("to", OTHERS)
def test_a_camera_without_skew_goes_through_each_format_and_back_exactly(to: str, tmp_path: Path) -> None:
    original = CameraFile(plain("CAHVOR", R=[0.0, -0.2, 0.05]), "camera")
    done = save_any(original, tmp_path / f"x.{to}.txt")
    again = load_any(tmp_path / f"x.{to}.txt")
    assert isinstance(again, CameraFile)
    assert done.worst_px < 1e-9
    assert twin_error(original.model, again.model).worst_px < 1e-6


@pytest.mark.parametrize("to", ["opencv", "ros", "kalibr", "mrcal"])
@pytest.mark.parametrize("name", ["cv.yml", "info.yaml"])
def test_one_familys_camera_goes_to_another_format_without_a_detour(
    to: str, name: str, tmp_path: Path
) -> None:
    """k3 is 0.02: a radtan lens has no place for it, the others hold all."""
    camera = read(tmp_path, name, TEXTS[name])
    lens = "plumb_bob" if to == "mrcal" else ""
    done = save_any(camera, tmp_path / f"y.{to}.txt", lens=lens)
    exact = to in ("opencv", "ros", "mrcal") or done.lens == ("rational_polynomial",)
    assert (done.worst_px < 1e-9) == exact
    assert done.worst_px < 0.2


def test_opencv_reads_what_is_written_for_it(tmp_path: Path) -> None:
    original = reference("navcam_left")
    save_any(original, tmp_path / "x.opencv.yaml")
    stored = load_any(tmp_path / "x.opencv.yaml")
    assert isinstance(stored, CameraFile)
    assert stored.frame == "head"
    store = cv2.FileStorage(str(tmp_path / "x.opencv.yaml"), cv2.FILE_STORAGE_READ)
    matrix, distortion = store.getNode("camera_matrix").mat(), store.getNode("distortion_coefficients").mat()
    pose = store.getNode("camera_from_frame").mat()
    assert store.getNode("image_width").real() == 1024
    assert store.getNode("frame").string() == "head"
    points = original.model.ray(np.array([[10.0, 20.0], [500.0, 400.0], [1000.0, 700.0]]))
    at = points.origins_m + 7.0 * points.directions
    seen = cv2.projectPoints(at, cv2.Rodrigues(pose[:3, :3])[0], pose[:3, 3], matrix, distortion)[0][:, 0]
    np.testing.assert_allclose(seen, stored.model.project(at)[0], atol=1e-9)
    # H and V lean by 0.58 mrad, which OpenCV's lenses have no place for: 0.19 px.
    assert np.abs(seen - [[10.0, 20.0], [500.0, 400.0], [1000.0, 700.0]]).max() < 0.2


def test_ros_finds_the_keys_that_its_parser_looks_for(tmp_path: Path) -> None:
    done = save_any({"navcam_left": reference("navcam_left")}, tmp_path / "left.ros.yaml")
    read_back = yaml.safe_load((tmp_path / "left.ros.yaml").read_text())
    assert read_back["camera_name"] == "navcam_left"
    assert read_back["distortion_model"] == done.lens[0] == "plumb_bob"
    for key, shape in (
        ("camera_matrix", (3, 3)),
        ("distortion_coefficients", (1, 5)),
        ("rectification_matrix", (3, 3)),
        ("projection_matrix", (3, 4)),
    ):
        matrix = read_back[key]
        assert (matrix["rows"], matrix["cols"]) == shape
        assert all(isinstance(value, float) for value in matrix["data"])
        assert len(matrix["data"]) == shape[0] * shape[1]


def test_a_chain_of_kalibr_places_each_camera_against_the_one_before(tmp_path: Path) -> None:
    cameras = read(tmp_path, "chain.yaml", CHAIN)
    first, second = (cameras[name] for name in ("cam0", "cam1"))
    assert first.frame == second.frame == "cam0"
    # x in cam1 = T x in cam0; cam1's origin is where T x is zero: x = -R^T t
    np.testing.assert_allclose(second.model.C, [0.003, -0.002, 0.11], atol=1e-12)
    np.testing.assert_allclose(second.model.A, [-1.0, 0.0, 0.0], atol=1e-12)
    pixel = second.model.project(np.array([[-5.0, -0.002, 0.11]]))[0][0]
    np.testing.assert_allclose(pixel, [373.9, 253.7], atol=1e-9)


def test_a_pair_goes_to_kalibr_and_back_with_its_baseline(tmp_path: Path) -> None:
    pair = {name: reference(name) for name in ("navcam_left", "navcam_right")}
    done = save_any(pair, tmp_path / "pair.kalibr.yaml")
    assert len(done.errors) == 2
    read_back = yaml.safe_load((tmp_path / "pair.kalibr.yaml").read_text())
    step = np.array(read_back["cam1"]["T_cn_cnm1"])
    baseline_m = np.linalg.norm(pair["navcam_left"].model.C - pair["navcam_right"].model.C)
    assert np.linalg.norm(step[:3, 3]) == pytest.approx(baseline_m, abs=1e-9)
    assert step[0, 3] == pytest.approx(-baseline_m, abs=0.01)  # the left one lies to the right one's left
    again = load_any(tmp_path / "pair.kalibr.yaml")
    assert isinstance(again, dict)
    for name, camera in zip(pair, again.values(), strict=True):
        assert twin_error(pair[name].model, camera.model).worst_px < 0.25
    with pytest.raises(BadFile, match="several frames"):
        save_any(pair | {"hazcam_left": reference("hazcam_left")}, tmp_path / "all.kalibr.yaml", limit_px=5)


def test_a_moving_entrance_point_counts_one_metre_away(tmp_path: Path) -> None:
    """E moves the ray's origin by millimetres: nothing far away, most of a pixel at 1 m."""
    still = plain("CAHVORE", R=[0.0, -0.02, 0.003])
    moving = plain("CAHVORE", R=[0.0, -0.02, 0.003], E=[0.02, 0.0, 0.0])
    assert save_any(CameraFile(still, "camera"), tmp_path / "a.kalibr.yaml").worst_px < 1e-9
    done = save_any(CameraFile(moving, "camera"), tmp_path / "b.kalibr.yaml", limit_px=1.0)
    assert 0.02 < done.worst_px < 1.0
    mrcal = save_any(CameraFile(moving, "camera"), tmp_path / "b.cameramodel")
    assert mrcal.worst_px < 1e-9


def test_a_conversion_beyond_the_limit_is_refused_and_writes_nothing(tmp_path: Path) -> None:
    with pytest.raises(
        BadFile, match=r"'camera' as \w+ is .* px off at worst.*the limit is 0\.25 px.*entrance"
    ):
        save_any(reference("hazcam_left"), tmp_path / "x.ros.yaml")
    with pytest.raises(BadFile, match="mrad off a right angle"):
        save_any(reference("navcam_left"), tmp_path / "x.ros.yaml", limit_px=0.01)
    assert not list(tmp_path.iterdir())


def test_opencv_gets_a_tilted_sensor_where_that_alone_is_near(tmp_path: Path) -> None:
    """A distortion about another axis than the picture's: without the tilt 0.07 px are lost."""
    lens, _, error = nearest_lens(read(tmp_path, "in.cameramodel", MODEL).model, "opencv")
    assert lens == "tilted"
    assert error.worst_px < 1e-4


def test_only_the_twin_of_a_wide_lens_is_bound_by_the_limit(tmp_path: Path) -> None:
    numbers = [0.9, 0.6, 0.001, -0.0007, 0.03, 1.3, 0.8, 0.1]
    wide = (
        INFO.replace("plumb_bob", "rational_polynomial")
        .replace("cols: 5, data: [-0.31, 0.12, 0.001, -0.0007, 0.02]", f"cols: 8, data: {numbers}")
        .replace("[600, 0, 319, 0, 601, 241, 0, 0, 1]", "[340, 0, 319, 0, 341, 241, 0, 0, 1]")
    )
    camera = read(tmp_path, "wide.yaml", wide)
    assert camera.notes == ()
    assert save_any(camera, tmp_path / "kept.yaml").errors == ()
    kept = load_any(tmp_path / "kept.yaml")
    assert isinstance(kept, CameraFile)
    assert (kept.model.kind, kept.model.distortion.tolist()) == ("OPENCV8", numbers)
    done = save_any(camera, tmp_path / "x.cahvor", limit_px=20.0)
    assert done.lens == ("CAHVOR",) or done.lens == ("CAHVORE",)
    with pytest.raises(BadFile, match=r"as CAHVORE? is .* the limit is"):
        save_any(camera, tmp_path / "y.cahvor", limit_px=0.5 * done.worst_px)


def test_what_mrcal_wrote_beside_the_camera_is_not_read(tmp_path: Path) -> None:
    camera = read(tmp_path, "a.cameramodel", MODEL)
    assert camera.notes == ("optimization_inputs: not read",)
    text = format_mrcal(camera.model, "rover").decode()
    again = parse_mrcal(text.encode(), "x")
    assert twin_error(camera.model, again.model).worst_px < 1e-9


@pytest.mark.parametrize(
    ("name", "old", "new", "phrase"),
    [
        ("info.yaml", "plumb_bob", "fov", "distortion_model: the text 'fov' where one of plumb_bob"),
        ("info.yaml", "rows: 3, cols: 3, data: [600, 0,", "rows: 3, cols: 3, data: [600, 5,", "fx, 0, cx"),
        ("info.yaml", "[600, 0, 319", "[0, 0, 319", "focal length"),
        ("info.yaml", "[600, 0, 319", "[-600, 0, 319", "two signs"),
        ("info.yaml", "image_width: 640", "image_width: 0", "image_width: 0 where an integer from 1"),
        ("info.yaml", "-0.31, 0.12", "-3.1, -0.9", "more than half of the image has no ray"),
        ("info.yaml", "-0.31", ".nan", "finite"),
        (
            "info.yaml",
            "-0.0007, 0.02]",
            "-0.0007, 0.02, 1]",
            "6 coefficients where one of 0, 4, 5, 8, 12, 14",
        ),
        ("cv.yml", "camera_matrix:", "matrix:", "camera_matrix: the key is missing"),
        ("cv.yml", "image_width: 640\n", "", "image_width: the key is missing"),
        ("chain.yaml", "cam1", "cam2", "cam0, cam1, ... in order"),
        (
            "chain.yaml",
            "camera_model: pinhole",
            "camera_model: omni",
            "cam0.camera_model: the text 'omni' where 'pinhole' is",
        ),
        ("chain.yaml", "radtan", "fov", "one of radtan, equidistant, none"),
        ("chain.yaml", "[0, 0, 1, -0.11]", "[0, 0, 2, -0.11]", "no rotation and translation"),
        (
            "chain.yaml",
            "  T_cn_cnm1:\n  - [0, 0, 1, -0.11]\n  - [0, 1, 0, 0.002]\n",
            "  x:\n",
            "T_cn_cnm1: the key",
        ),
        ("a.cameramodel", "LENSMODEL_CAHVOR", "LENSMODEL_LONLAT", "mrcal-convert-lensmodel"),
        ("a.cameramodel", "1226.5,", "", "a list of 9 numbers"),
        ("a.cameramodel", "'imagersize': [ 1024, 768,],", "", "imagersize: the key is missing"),
        ("a.cameramodel", "CAHVOR'", "CAHVORE_linearity=0.5'", "a list of 9 where a list of 12"),
    ],
)
def test_a_bad_file_is_refused_in_one_sentence(
    name: str, old: str, new: str, phrase: str, tmp_path: Path
) -> None:
    assert old in TEXTS[name]
    with pytest.raises(BadFile) as refused:
        read(tmp_path, name, TEXTS[name].replace(old, new, 1))
    assert phrase in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("name", TEXTS)
def test_a_format_is_known_by_its_content(name: str, tmp_path: Path) -> None:
    expected = read(tmp_path, name, TEXTS[name])
    found = read(tmp_path, "anything.dat", TEXTS[name])
    assert type(found) is type(expected)


def test_an_unknown_format_lens_or_suffix_is_refused(tmp_path: Path) -> None:
    camera = reference("navcam_left")
    for path, options, phrase in (
        ("x.png", {}, "suffix '.png' where"),
        ("x", {}, "suffix '' where"),
        ("x.yaml", {"format": "bag"}, "format 'bag' where one of"),
        ("x.kalibr.yaml", {"lens": "plumb_bob"}, "lens 'plumb_bob' where one of radtan, equidistant"),
        ("x.yaml", {"lens": "radtan"}, "holds the camera's own model"),
    ):
        with pytest.raises(BadFile, match=phrase):
            save_any(camera, tmp_path / path, **options)  # type: ignore[arg-type]
    with pytest.raises(BadFile, match="2 cameras where one is expected"):
        save_any({"a": camera, "b": camera}, tmp_path / "x.ros.yaml")
    assert not list(tmp_path.iterdir())


def test_a_mirrored_image_is_refused_not_turned(tmp_path: Path) -> None:
    model = plain("CAHV", V=[0.0, -500.0, 239.5])
    with pytest.raises(BadFile, match="mirrored"):
        save_any(CameraFile(model, "camera"), tmp_path / "x.opencv.yaml")
