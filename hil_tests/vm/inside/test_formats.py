"""Formats, sizes and controls on the kernel's vivid, compared with OpenCV as an independent reader."""

from __future__ import annotations

import re
import time

import cv2
import numpy as np
import pytest

from drivers import pixels
from drivers.errors import UnsupportedFormat
from drivers.v4l2 import find
from drivers.v4l2.camera import V4l2Camera, open_camera
from drivers.v4l2.controls import get_value, list_controls, set_by_name
from drivers.v4l2.find import Address, open_node

from .conftest import BUS, STEADY, options

UNCOMPRESSED = [
    code for code, layout in pixels.FORMATS.items() if layout.kind != "jpeg" and not layout.packed
]  # vivid has no packed ones
SIZES = [(320, 180), (640, 360), (640, 480), (1280, 720)]
ROUNDING_DN = 3  # vivid computes its colours for each format anew


def frame_of(camera: V4l2Camera) -> np.ndarray:
    return camera.next_frame(time.monotonic(), 5.0).image


def picture(code: str, index: int, **more: object) -> np.ndarray:
    camera = open_camera(options(index, format=code, **{"colour": True, **more}), name="left")
    try:
        return frame_of(camera)
    finally:
        camera.close()


@pytest.mark.parametrize("size_px", SIZES)
@pytest.mark.parametrize("code", ["YUYV", "GREY"])
def test_sizes_come_as_asked(code: str, size_px: tuple[int, int]) -> None:
    camera = open_camera(options(format=code, size_px=list(size_px), rate_hz=10.0), name="left")
    try:
        assert frame_of(camera).shape == size_px[::-1]
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


def test_luma_is_the_same_to_the_last_bit_as_opencv_reads_it() -> None:
    camera = open_camera(options(format="YUYV"), name="left")
    node = camera.capture.identity
    ours = frame_of(camera)
    camera.close()
    path = next(c.node for c in find.list_cameras() if c.bus == node.bus)
    opened = cv2.VideoCapture(str(path), cv2.CAP_V4L2)
    opened.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*"YUYV"))
    opened.set(cv2.CAP_PROP_FRAME_WIDTH, 640)
    opened.set(cv2.CAP_PROP_FRAME_HEIGHT, 480)
    opened.set(cv2.CAP_PROP_CONVERT_RGB, 0)
    good, theirs = opened.read()
    opened.release()
    assert good
    assert np.array_equal(ours, np.asarray(theirs).reshape(480, 640, 2)[..., 0])


@pytest.mark.parametrize("colour", [False, True])
def test_two_planes_show_what_one_shows(colour: bool) -> None:
    pictures = [picture(code, 1, colour=colour, size_px=[640, 360]) for code in ("NV12", "NM12")]
    assert np.array_equal(*pictures)
    assert pictures[0].std() > 40  # bars, not an empty buffer


def test_a_format_that_the_camera_lacks_is_told_with_those_it_has() -> None:
    with pytest.raises(
        UnsupportedFormat, match=r"left: the camera has no format MJPG; it has YUYV, UYVY, NV12, GREY"
    ):
        open_camera(options(format="MJPG"), name="left")


def test_a_size_that_the_camera_lacks_is_told_with_those_it_has() -> None:
    with pytest.raises(UnsupportedFormat, match="no 641x480 in YUYV; it has 320x180, 640x360, 640x480"):
        open_camera(options(size_px=[641, 480]), name="left")


def test_a_rate_that_the_camera_lacks_is_told_with_those_it_has() -> None:
    with pytest.raises(UnsupportedFormat, match=r"no rate of 120 Hz at 640x480 in YUYV; it has 1, .* 25 Hz"):
        open_camera(options(rate_hz=120.0), name="left")


def test_controls_are_set_and_read_back() -> None:
    with open_node(Address(bus=BUS[0]), "left") as node:
        assert set_by_name(node, {"brightness": 77, "test_pattern": 3, "Saturation": 40}) == []
        values = {c.name: get_value(node, c) for c in list_controls(node)}
        assert (values["brightness"], values["test_pattern"], values["saturation"]) == (77, 3, 40)
        set_by_name(node, {"brightness": 128, "test_pattern": 0, "saturation": 128})


def test_a_brighter_camera_gives_brighter_pictures() -> None:
    camera = open_camera(options(controls={"brightness": 128}), name="left")
    before = frame_of(camera).mean()
    with open_node(Address(bus=BUS[0]), "beside") as node:
        set_by_name(node, {"brightness": 160})
    after = frame_of(camera).mean()
    camera.close()
    with open_node(Address(bus=BUS[0]), "beside") as node:
        set_by_name(node, {"brightness": 128})
    assert after == pytest.approx(before + 32, abs=5)


@pytest.mark.parametrize(
    ("controls", "words"),
    [
        ({"brightnes": 3}, "no control 'brightnes'; did you mean 'brightness'"),
        ({"brightness": 300}, r"brightness is to be 300, outside its range \(0 to 255, step 1\)"),
        ({"read_only_integer_32_bits": 3}, "cannot be set"),
        ({"string": 3}, "cannot be set"),
        (
            {"timestamp_source": "noon"},
            "timestamp_source is no 'noon'; it takes End of Frame, Start of Exposure",
        ),
    ],
)
def test_controls_that_cannot_be_set_are_told(controls: dict[str, int | str], words: str) -> None:
    with open_node(Address(bus=BUS[0]), "left") as node:
        (problem,) = set_by_name(node, controls)
    assert re.search(words, problem.message)


def test_a_camera_without_exposure_and_focus_says_so_and_works() -> None:
    camera = open_camera(options(exposure_s=0.01, focus=30, gain=20), name="left")
    try:
        told = [problem.message for problem in camera.capture.problems]
        frame = camera.next_frame(time.monotonic(), 5.0)
    finally:
        camera.close()
    assert "the camera has no control for exposure; it stays as it is" in told
    assert "the camera has no control for focus; it stays as it is" in told
    assert not any("gain" in words for words in told)
    assert frame.set_exposure_s is None


def test_controls_of_unknown_types_are_listed_and_do_not_hide_others() -> None:
    with open_node(Address(bus=BUS[0]), "left") as node:
        controls = {c.name: c for c in list_controls(node)}
    assert len(controls) > 40 and set(STEADY) <= set(controls)
    assert controls["string"].kind == "string" and not controls["string"].settable
    assert controls["integer_64_bits"].minimum == -(2**63)
    assert controls["menu"].menu and controls["integer_menu"].menu
