"""A calibration in another mode of its camera: beside OpenCV, beside rendered pictures, and refused."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from typing import Any

import cv2
import numpy as np
import pytest

from calib.geometry.cahvor import CameraModel
from calib.geometry.covariance import pixel_rates, rig_in_mode, stored_covariance
from calib.geometry.lenses import opencv
from calib.geometry.mode import (
    BadMode,
    Mode,
    PixelChange,
    SensorMode,
    in_mode,
    mode_between,
    pixel_change,
    sensor_mode_after,
)
from calib.geometry.parameters import parameter_names
from calib.geometry.pointing import solve
from calib.geometry.rig import Mast, Rig, RigCamera

SIZE = (640, 480)
SAME_PX = 1e-9
CROP = (96, 40, 512, 400)
MODES = [
    Mode(crop_px=crop, binning=binning, flip=flip)
    for crop, binning, flip in product(
        (None, CROP), ((1, 1), (2, 2), (2, 4)), ((False, False), (True, False), (False, True), (True, True))
    )
]
DISTORTION = [-0.21, 0.09, 0.003, -0.002, 0.01, 0.05, -0.02, 0.004, 0.002, -0.001, 0.003, 0.0005, 0.02, -0.03]


def opencv_camera(count: int) -> tuple[CameraModel, np.ndarray, np.ndarray]:
    """A camera of OpenCV's with its axes along ours, its matrix, and its coefficients."""
    matrix = np.array([[520.0, 0.0, 310.5], [0.0, 505.0, 251.25], [0.0, 0.0, 1.0]])
    coefficients = np.array(DISTORTION[:count])
    kind: Any = f"OPENCV{count}"
    made = CameraModel(
        kind, SIZE, C=np.zeros(3), A=[0, 0, 1], H=matrix[0], V=matrix[1], distortion=coefficients
    )
    return made, matrix, coefficients


def points(count: int = 400) -> np.ndarray:
    random = np.random.default_rng(5)
    return np.column_stack([random.uniform(-0.5, 0.5, (count, 2)), np.ones(count)]) * 3.0


def new_pixels(change: PixelChange, pixels_px: np.ndarray) -> np.ndarray:
    """Where pixels (..., 2) of the calibrated picture are in the new one."""
    return pixels_px * change.scale + change.shift


def cahvor() -> CameraModel:
    axis = np.array([0.98, 0.1, 0.12])
    axis /= np.linalg.norm(axis)
    optical = np.array([0.981, 0.103, 0.118])
    optical /= np.linalg.norm(optical)
    return CameraModel(
        "CAHVOR", SIZE, C=[0.2, -0.1, 0.05], A=axis, H=310 * axis + [-60.0, 500.0, 3.0],
        V=235 * axis + [-50.0, 4.0, 498.0], O=optical, R=[0.0, -0.11, 0.03],
    )  # fmt: skip


@pytest.mark.parametrize("count", opencv.COUNTS)
def test_pixels_of_every_mode_are_those_of_opencv_with_a_scaled_matrix(count: int) -> None:
    """cv2.projectPoints with the matrix that the pixel rule makes, also with negative focal lengths."""
    camera, matrix, coefficients = opencv_camera(count)
    for mode in MODES:
        x, y, width, height = mode.crop_px or (0, 0, *SIZE)
        changed = matrix.copy()
        for row, (begin, by, length, flip) in enumerate(
            zip((x, y), mode.binning, (width, height), mode.flip, strict=True)
        ):
            changed[row, row] /= by
            changed[row, 2] = (changed[row, 2] - begin + 0.5) / by - 0.5
            if flip:
                changed[row, row] *= -1
                changed[row, 2] = length // by - 1 - changed[row, 2]
        expected = cv2.projectPoints(points(), np.zeros(3), np.zeros(3), changed, coefficients)[0][:, 0]
        seen, valid = in_mode(camera, mode)[0].project(points())
        assert valid.sum() > 300, mode
        assert np.abs(seen - expected)[valid].max() < SAME_PX, mode


@pytest.mark.parametrize("kind", ["CAHV", "CAHVOR", "CAHVORE", "OPENCV_FISHEYE"])
def test_rays_and_pixels_of_other_models_agree_with_the_full_picture(kind: str) -> None:
    camera = cahvor()
    if kind == "CAHVORE":
        camera = replace(camera, kind="CAHVORE", E=[1e-4, -2e-5, 3e-5], cahvore_type=3, linearity=0.4)
    elif kind == "OPENCV_FISHEYE":
        camera = replace(
            camera, kind="OPENCV_FISHEYE", O=None, R=None, distortion=[0.02, -0.01, 0.003, -0.001]
        )
    elif kind == "CAHV":
        camera = replace(camera, kind="CAHV", O=None, R=None)
    pixels = np.stack(np.meshgrid(np.linspace(100, 600, 7), np.linspace(45, 435, 6)), axis=-1).reshape(-1, 2)
    full = camera.ray(pixels)
    assert full.valid.all()
    for mode in MODES:
        there = new_pixels(pixel_change(SIZE, mode), pixels)
        rays = in_mode(camera, mode)[0].ray(there)
        assert rays.valid.all(), mode
        assert np.abs(rays.directions - full.directions).max() < 1e-12
        assert np.abs(rays.origins_m - full.origins_m).max() < 1e-12


def test_the_middle_of_the_picture_and_its_corners_go_where_the_rule_says() -> None:
    change = pixel_change((640, 480), Mode(binning=(2, 2)))
    assert new_pixels(change, np.array([[319.5, 239.5], [0.5, 0.5], [639, 479]])).tolist() == [
        [159.5, 119.5], [0.0, 0.0], [319.25, 239.25],
    ]  # fmt: skip
    change = pixel_change((640, 480), Mode(crop_px=(10, 20, 300, 200), flip=(True, False)))
    assert change.size_px == (300, 200)
    assert new_pixels(change, np.array([[10, 20], [309, 219]])).tolist() == [[299.0, 0.0], [0.0, 199.0]]


def rig(model: CameraModel) -> Rig:
    names = [f"cameras.eye.{name}" for name in parameter_names(model.kind)] + ["mast.translation_m.x"]
    root = np.random.default_rng(3).normal(size=(len(names), len(names))) * 1e-4
    fit = {"parameters": names, "covariance": (root @ root.T).tolist(), "rms_px": 0.1}
    mast = Mast(np.array([0.3, 0.0, -1.4]), np.zeros(3))
    return Rig("little", mast, {"eye": RigCamera("head", model)}, fit=fit)


@pytest.mark.parametrize("model", [cahvor(), opencv_camera(14)[0]], ids=["CAHVOR", "OPENCV14"])
def test_the_covariance_of_a_pixel_is_that_of_the_full_picture_scaled(model: CameraModel) -> None:
    point = model.C + 4.0 * model.ray(np.array([350.0, 260.0])).directions
    known = stored_covariance(rig(model))
    assert known is not None
    for mode in MODES:
        changed = rig_in_mode(rig(model), "eye", mode)
        assert "rms_px" not in changed.fit
        carried = stored_covariance(changed)
        assert carried is not None
        spread = []
        for one, covariance in ((rig(model), known), (changed, carried)):
            seen = one.mast.rover_from_head(0.0, 0.0).points(point[None])
            rates = pixel_rates(one, covariance.names, "eye", 0.0, 0.0, seen).to_rig[0]
            spread.append(rates @ covariance.covariance @ rates.T)
        scale = np.diag(pixel_change(SIZE, mode).scale)
        assert np.allclose(spread[1], scale @ spread[0] @ scale, rtol=1e-7, atol=1e-12)


def test_pointing_at_a_carried_over_pixel_is_pointing_at_the_full_ones() -> None:
    mast, target, pixel = (
        Mast(np.array([0.3, 0.0, -1.4]), np.zeros(3)),
        np.array([6.0, 1.0, 0.2]),
        (400.0, 200.0),
    )
    full = solve(mast, cahvor(), target, pixel)
    assert full
    for mode in MODES:
        there = new_pixels(pixel_change(SIZE, mode), np.array(pixel))
        found = solve(mast, in_mode(cahvor(), mode)[0], target, there)
        angles = [np.array([[one.pan_rad, one.tilt_rad] for one in some]) for some in (found, full)]
        assert np.abs(angles[0] - angles[1]).max() < 1e-12, mode


@pytest.mark.parametrize(
    ("mode", "words"),
    [
        (
            Mode(crop_px=(200, 0, 500, 480)),
            "the crop of 500x480 px from (200, 0) is not inside the calibrated",
        ),
        (Mode(crop_px=(-1, 0, 10, 10)), "is not inside"),
        (Mode(binning=(3, 3)), "binning by 3 does not divide a picture 640 px wide"),
        (Mode(binning=(1, 7)), "binning by 7 does not divide a picture 480 px high"),
        (Mode(binning=(0, 1)), "binning by 0"),
    ],
)
def test_a_mode_that_is_not_one_is_refused_in_a_sentence(mode: Mode, words: str) -> None:
    with pytest.raises(BadMode) as refusal:
        in_mode(cahvor(), mode)
    assert words in str(refusal.value)


SENSOR = (96, 64)
FULL = SensorMode(SENSOR, (0, 0, *SENSOR), SENSOR)
SENSOR_MODES = [
    FULL,
    SensorMode((48, 32), (0, 0, *SENSOR), SENSOR),
    SensorMode((24, 32), (0, 0, *SENSOR), SENSOR),
    SensorMode((64, 48), (16, 8, 64, 48), SENSOR),
    SensorMode((16, 24), (16, 8, 64, 48), SENSOR),
    SensorMode((40, 20), (12, 30, 40, 20), SENSOR),
    SensorMode((10, 10), (12, 30, 40, 20), SENSOR),
    SensorMode(SENSOR, (0, 0, *SENSOR), SENSOR, (True, False)),
    SensorMode((32, 24), (16, 8, 64, 48), SENSOR, (True, True)),
]


def seen(sensor: np.ndarray, mode: SensorMode) -> np.ndarray:
    """What a camera in a mode gives: cut out, averaged and turned by OpenCV."""
    assert mode.crop_px is not None
    x, y, width, height = mode.crop_px
    cut = cv2.resize(sensor[y : y + height, x : x + width], mode.size_px, interpolation=cv2.INTER_AREA)
    return turned(cut, mode.flip)


def turned(picture: np.ndarray, flip: tuple[bool, bool]) -> np.ndarray:
    code = {(True, False): 1, (False, True): 0, (True, True): -1}.get(flip)
    return picture if code is None else cv2.flip(picture, code)


def test_a_picture_changes_its_sensor_mode_as_opencv_cuts_it() -> None:
    """Each pair of modes either changes into one another to the last grey level, or is refused."""
    sensor = np.random.default_rng(3).uniform(0, 255, SENSOR[::-1])
    carried = 0
    for then, now in product(SENSOR_MODES, repeat=2):
        try:
            mode = mode_between(then, now)
        except BadMode:
            continue
        x, y, width, height = mode.crop_px or (0, 0, *then.size_px)
        part = seen(sensor, then)[y : y + height, x : x + width]
        size = width // mode.binning[0], height // mode.binning[1]
        made = turned(cv2.resize(part, size, interpolation=cv2.INTER_AREA), mode.flip)
        assert np.abs(made - seen(sensor, now)).max() < 1e-9, (then, now)
        assert sensor_mode_after(then, mode) == now
        assert pixel_change(then.size_px, mode).size_px == now.size_px
        carried += 1
    assert carried == 33


@pytest.mark.parametrize(
    ("then", "now", "words"),
    [
        (SENSOR_MODES[3], FULL, "they show more of the sensor along x than was calibrated"),
        (SENSOR_MODES[1], FULL, "a scale of 2 along x is no binning"),
        (FULL, replace(FULL, size_px=(64, 64)), "a scale of 0.667 along x is no binning"),
        (
            SENSOR_MODES[1],
            SensorMode((47, 32), (1, 0, 94, 64), SENSOR),
            "begins or ends amid a pixel along x",
        ),
        (FULL, SensorMode((96, 60), (0, 0, 96, 60), (96, 60)), "a sensor of 96x60 px where the calibrated"),
        (FULL, replace(SENSOR_MODES[5], flip=(True, False)), "the crop is not in the middle"),
        (SensorMode((96, 64)), SENSOR_MODES[5], "which part of the sensor they show is not known"),
    ],
)
def test_a_sensor_mode_that_no_change_leads_to_is_refused_with_the_reason(
    then: SensorMode, now: SensorMode, words: str
) -> None:
    with pytest.raises(BadMode, match=words):
        mode_between(then, now)


def test_what_a_driver_does_not_tell_is_not_compared_and_flips_are() -> None:
    untold = SensorMode(SENSOR, flip=(False, True))
    assert mode_between(FULL, untold) == mode_between(untold, FULL) == Mode(flip=(False, True))
    assert mode_between(untold, untold) == Mode()
    assert sensor_mode_after(untold, Mode(binning=(2, 2))) == SensorMode((48, 32), flip=(False, True))
    assert sensor_mode_after(FULL, Mode(crop_px=(0, 0, *FULL.size_px))) == FULL
    off_middle = replace(SENSOR_MODES[5], flip=(True, False))
    assert mode_between(off_middle, off_middle) == Mode(), "the same is the same, from whatever side"
    assert sensor_mode_after(off_middle, Mode(crop_px=(0, 0, 20, 20))) is None


@pytest.mark.parametrize("size_px", [None, (64,), (64, 0), (64.0, 48), "64"])
def test_a_sensor_mode_of_no_size_is_refused(size_px: object) -> None:
    with pytest.raises(ValueError, match=r"size_px is .*, expected .width, height. of 1 px and more"):
        SensorMode(size_px)  # type: ignore[arg-type]


def test_a_size_is_kept_as_a_tuple() -> None:
    assert SensorMode([64, 48]) == SensorMode((64, 48))  # type: ignore[arg-type]
