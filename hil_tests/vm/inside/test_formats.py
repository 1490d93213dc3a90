"""Formats, sizes and controls on the kernel's vivid, compared with OpenCV as an independent reader."""

from __future__ import annotations

import time

import numpy as np
import pytest

from drivers import pixels
from drivers.errors import UnsupportedFormat
from drivers.v4l2.camera import V4l2Camera, open_camera

from .conftest import options

UNCOMPRESSED = [
    code for code, layout in pixels.FORMATS.items() if layout.kind != "jpeg" and not layout.packed
]  # vivid has no packed ones


def frame_of(camera: V4l2Camera) -> np.ndarray:
    return camera.next_frame(time.monotonic(), 5.0).image


def picture(code: str, index: int, **more: object) -> np.ndarray:
    camera = open_camera(options(index, format=code, **{"colour": True, **more}), name="left")
    try:
        return frame_of(camera)
    finally:
        camera.close()


@pytest.mark.parametrize("code", UNCOMPRESSED)
def test_every_format_shows_the_colour_bars(code: str) -> None:
    image = picture(code, index=1 if code == "NM12" else 0)
    assert image.shape == (480, 640, 3)
    bars = image[240, 40::80].astype(int)  # the middles of eight bars: white, yellow, cyan ... black
    grey = pixels.FORMATS[code].kind == "grey"
    if grey:
        assert (np.diff(bars[:, 0]) < 0).all()  # the bars' luma falls from left to right
        return
    wanted = [
        (255, 255, 255),
        (255, 255, 0),
        (0, 255, 255),
        (0, 255, 0),
        (255, 0, 255),
        (255, 0, 0),
        (0, 0, 255),
    ]
    for bar, (red, green, blue) in zip(bars, wanted, strict=False):
        bright = np.array([blue, green, red]) > 127
        assert bar[bright].min() > 140 and (bright.all() or bar[~bright].max() < 60), (code, bar)


def test_a_rate_that_the_camera_lacks_is_told_with_those_it_has() -> None:
    with pytest.raises(UnsupportedFormat, match=r"no rate of 120 Hz at 640x480 in YUYV; it has 1, .* 25 Hz"):
        open_camera(options(rate_hz=120.0), name="left")


def test_a_camera_without_exposure_and_focus_says_so_and_works() -> None:
    camera = open_camera(options(exposure_s=0.01, focus=30, gain=20), name="left")
    try:
        told = [problem.message for problem in camera.problems]
        frame = camera.next_frame(time.monotonic(), 5.0)
    finally:
        camera.close()
    assert "the camera has no control for exposure; it stays as it is" in told
    assert "the camera has no control for focus; it stays as it is" in told
    assert not any("gain" in words for words in told)
    assert frame.set_exposure_s is None
