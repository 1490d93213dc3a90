"""Crop, scaling and flips of the kernel's vivid, set by v4l2-ctl and read by the driver, and its pictures."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Iterator

import numpy as np
import pytest

from calib.geometry.mode import Mode, SensorMode, mode_between
from drivers.errors import BadFrame
from drivers.v4l2 import find
from drivers.v4l2.camera import open_camera
from hil_tests.vm.inside.conftest import BUS, options
from hil_tests.waiting import NET_S
from mastctl.devices.frames import check_mode

SENSOR = (640, 480)
FULL = SensorMode(SENSOR, (0, 0, *SENSOR), SENSOR)


def v4l2_ctl(*words: str) -> None:
    """Have v4l2-ctl change the second camera."""
    node = next(one.node for one in find.list_cameras() if one.bus == BUS[1])
    subprocess.run(["v4l2-ctl", "-d", str(node), *words], capture_output=True, timeout=NET_S, check=True)


@pytest.fixture
def hdmi() -> Iterator[None]:
    """The second camera's other input, which can be cropped and scaled as no webcam can."""
    v4l2_ctl("--set-input", "1")
    v4l2_ctl("--set-dv-bt-timings", "cvt,width=640,height=480,fps=60")
    yield
    v4l2_ctl("-c", "horizontal_flip=0,vertical_flip=0")
    v4l2_ctl("--set-input", "0")


def seen(size_px: tuple[int, int], **controls: object) -> tuple[SensorMode, np.ndarray]:
    """The mode that the driver reads, and a picture in it."""
    steady = {"test_pattern": "100% Color Squares", "horizontal_flip": 0, "vertical_flip": 0, **controls}
    camera = open_camera(options(1, size_px=list(size_px), rate_hz=None, controls=steady), name="right")
    try:
        return camera.info.sensor_mode, camera.next_frame(time.monotonic(), NET_S).image.astype(int)
    finally:
        camera.close()


def same(one: np.ndarray, other: np.ndarray) -> bool:
    """Whether two pictures agree but for the edges of squares, where vivid mixes two pixels' colors."""
    return bool((one == other).mean() > 0.97)


@pytest.mark.usefixtures("hdmi")
def test_crop_and_flips_are_read_as_the_pictures_show_them() -> None:
    mode, full = seen(SENSOR)
    assert mode == FULL and not same(full, full[:, ::-1]) and not same(full, full[::-1])
    mode, mirrored = seen(SENSOR, horizontal_flip=1)
    assert mode_between(FULL, mode) == Mode(flip=(True, False)) and same(mirrored, full[:, ::-1])
    mode, upside_down = seen(SENSOR, vertical_flip=1)
    assert mode_between(FULL, mode) == Mode(flip=(False, True)) and same(upside_down, full[::-1])
    v4l2_ctl("--set-selection", "target=crop,flags=0,left=160,top=96,width=320,height=240")
    mode, part = seen((320, 240))
    assert mode == SensorMode((320, 240), (160, 96, 320, 240), SENSOR)
    assert mode_between(FULL, mode) == Mode((160, 96, 320, 240)) and same(part, full[96:336, 160:480])
    with pytest.raises(BadFrame, match="--camera right --crop 160 96 320 240 --out"):
        check_mode("right", mode, FULL)
