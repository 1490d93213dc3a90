"""The nearest plumb_bob camera, against OpenCV's own projection and ray directions worked out elsewhere."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from calib.files.mast_file import load_rig
from calib.files.opencv_camera import nearest_plumb_bob
from calib.geometry.cahvor import CameraModel
from mastctl.config import load_config

ROUNDING_PX = 1e-6


def models() -> dict[str, CameraModel]:
    cameras = load_rig(load_config().mast_file).rig.cameras
    return {name: camera.model for name, camera in cameras.items()}


@pytest.mark.parametrize("name", sorted(models()))
def test_the_stated_error_is_what_opencv_makes_of_the_numbers(name: str) -> None:
    model = models()[name]
    near = nearest_plumb_bob(model)
    width, height = model.size_px
    pixels = np.array([[x, y] for x in np.linspace(0, width - 1, 25) for y in np.linspace(0, height - 1, 19)])
    far = 1e6 * model.ray(pixels).directions @ near.frame_from_camera
    seen, _ = cv2.projectPoints(far, np.zeros(3), np.zeros(3), near.matrix_px, near.distortion)
    off = np.linalg.norm(seen.reshape(-1, 2) - pixels, axis=1)
    assert near.worst_px == pytest.approx(off.max(), abs=ROUNDING_PX)
    assert near.rms_px == pytest.approx(np.sqrt(np.mean(off**2)), abs=ROUNDING_PX)
    assert np.allclose(near.project(far), seen.reshape(-1, 2), atol=ROUNDING_PX)


def test_a_camera_without_distortion_is_met_exactly_and_one_with_a_narrow_view_nearly() -> None:
    plain = CameraModel("CAHV", (640, 480), C=[0, 0, 0], A=[0, 0, 1], H=[500, 0, 319.5], V=[0, 510, 239.5])
    near = nearest_plumb_bob(plain)
    assert near.worst_px < ROUNDING_PX
    assert near.matrix_px == pytest.approx(np.array([[500, 0, 319.5], [0, 510, 239.5], [0, 0, 1]]), abs=1e-6)
    assert nearest_plumb_bob(models()["navcam_left"]).worst_px < 0.5


def test_a_fisheye_says_how_far_it_is_off_instead_of_pretending() -> None:
    assert nearest_plumb_bob(models()["hazcam_left"]).worst_px > 10.0
