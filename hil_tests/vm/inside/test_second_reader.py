"""Our reader beside v4l2-ctl, which shares nothing with it: the same still picture to the last bit."""

from __future__ import annotations

import re
import shutil
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.clock import SystemClock
from drivers.v4l2 import find
from drivers.v4l2.camera import V4l2Camera
from drivers.v4l2.controls import list_controls
from drivers.v4l2.find import Address
from drivers.v4l2.settings import parse_options
from hil_tests.vm.inside.conftest import BUS, options

pytestmark = pytest.mark.skipif(
    shutil.which("v4l2-ctl") is None, reason="v4l2-ctl is not installed: apt-get install v4l-utils"
)


def by_v4l2_ctl(file: Path, code: str, size_px: tuple[int, int], index: int = 0) -> NDArray[np.uint8]:
    """The bytes of the tenth frame of a stream that v4l2-ctl takes, in the size and format set by it."""
    node = next(camera.node for camera in find.list_cameras() if camera.bus == BUS[index])
    size = f"width={size_px[0]},height={size_px[1]}"
    done = subprocess.run(
        ["v4l2-ctl", "-d", str(node), f"--set-fmt-video={size},pixelformat={code.ljust(4)}",
         "--stream-mmap=4", "--stream-skip=9", "--stream-count=1", f"--stream-to={file}"],
        capture_output=True, text=True, timeout=60,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return np.fromfile(file, np.uint8)


def our_bytes(count: int, index: int = 0, **more: object) -> list[NDArray[np.uint8]]:
    """The bytes of some frames one after the other, as the camera's thread holds them."""
    camera = V4l2Camera(parse_options(options(index, **more), "left"), "left", SystemClock())
    camera._convert = lambda format, raw: raw.copy()
    after_s, found = time.monotonic(), []
    try:
        for _ in range(count):
            taken = camera.next_frame(after_s, 10.0)
            after_s = taken.exposure_began_s
            found.append(taken.image)
    finally:
        camera.close()
    return found


@pytest.mark.parametrize("pattern", ["75% Colorbar", "Gray Ramp"])
@pytest.mark.parametrize(
    "code", ["YUYV", "UYVY", "GREY", "Y10", "Y12", "Y16", "NV12", "BA81", "RG10", "GB12", "BYR2"]
)
def test_frames_are_the_same_to_the_last_bit(tmp_path: Path, code: str, pattern: str) -> None:
    size_px = (640, 480)
    ours = our_bytes(1, format=code, size_px=list(size_px), controls={"test_pattern": pattern})[0]
    theirs = by_v4l2_ctl(tmp_path / "frame", code, size_px)
    assert len(np.unique(theirs)) > 1  # a picture, not an empty buffer
    assert np.array_equal(ours, theirs)


@pytest.mark.parametrize("code", ["YUYV", "NV12", "NM12"])
def test_multi_planar_frames_are_the_same_to_the_last_bit(tmp_path: Path, code: str) -> None:
    size_px = (640, 360)
    controls = {"test_pattern": "75% Colorbar"}
    ours = our_bytes(1, 1, format=code, size_px=list(size_px), controls=controls)[0]
    theirs = by_v4l2_ctl(tmp_path / "frame", code, size_px, 1)
    assert len(np.unique(theirs)) > 1
    assert np.array_equal(ours, theirs)


def test_controls_are_those_that_v4l2_ctl_lists_compound_ones_too() -> None:
    with find.open_node(Address(bus=BUS[0]), "left") as node:
        found = list_controls(node)
        told = subprocess.run(
            ["v4l2-ctl", "-d", str(node.path), "--list-ctrls"], capture_output=True, text=True, timeout=60
        ).stdout
    theirs = re.findall(r"^ *\w+ (0x[0-9a-f]{8}) \(", told, re.MULTILINE)
    assert len(theirs) > 20 and sorted(f"{one.id:#010x}" for one in found) == sorted(theirs)
    compound = [one.name for one in found if one.kind.startswith("type ")]
    assert "u16_8x16_matrix" in compound and "u16_8x16_matrix" in told, (compound, told)
