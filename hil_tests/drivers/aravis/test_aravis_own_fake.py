"""The driver ``aravis`` on Aravis's own fake camera: another's simulator, with packets over the loopback."""

from __future__ import annotations

import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.aravis import find, library
from drivers.aravis.camera import AravisCamera, open_camera
from drivers.errors import NoCamera
from drivers.newest import TimedFrame
from hil_tests.waiting import NET_S, until

pytestmark = pytest.mark.skipif(
    not library.installed(), reason=f"libaravis-0.8 is not installed: {library.INSTALL}"
)

OPTIONS: dict[str, Any] = {
    "address": "127.0.0.1", "size_px": [320, 240], "rate_hz": 40, "exposure_s": 0.01, "stamp": "start",
}  # fmt: skip
Start = Callable[..., subprocess.Popen[str]]


def _locked(lock: socket.socket) -> bool:
    """Whether this process has the machine's one name for it, which goes with the process."""
    try:
        lock.bind("\0mastctl tests: GigE Vision at 127.0.0.1")
    except OSError:
        return False
    return True


def fakes() -> Iterator[Start]:
    """Starts Aravis's fake; one at a time on a machine, since all have one address and port."""
    running: list[subprocess.Popen[str]] = []

    def start(serial: str) -> subprocess.Popen[str]:
        program = [sys.executable, str(Path(__file__).with_name("aravis_fake.py")), serial]
        process = subprocess.Popen(program, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        running.append(process)
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        return process

    with socket.socket(socket.AF_UNIX) as lock:
        until(lambda: _locked(lock), "the other suite's fake to end")
        yield start
        for process in running:
            process.kill()
            process.communicate()


fake = pytest.fixture(name="fake")(fakes)


def is_ramp(frame: TimedFrame) -> bool:
    """Whether every pixel is as the fake draws it at an exposure time of 10 ms: (x + y + number) % 255."""
    rows, columns = np.indices(frame.image.shape)
    return bool(np.array_equal(frame.image, (columns + rows + frame.driver_sequence) % 255))


def true_stamp_s(frame: TimedFrame) -> float:
    """The fake's stamp is the wall clock's, which this machine can tell."""
    return frame.stamp_s - (time.time() - time.monotonic())


def taken(camera: AravisCamera, count: int) -> list[TimedFrame]:
    return [camera.next_frame(time.monotonic(), NET_S) for _ in range(count)]


def test_pictures_and_times_are_the_fakes(fake: Start) -> None:
    fake("A1")
    camera = open_camera(OPTIONS, name="cam")
    for frame in taken(camera, 8):
        assert is_ramp(frame)
        assert frame.exposure_began_s <= true_stamp_s(frame) <= frame.exposure_began_s + frame.exposure_s
    camera.close()


def test_it_is_found_by_its_serial_number_and_by_its_name(fake: Start) -> None:
    fake("A2")
    listed = [one for one in find.list_cameras() if one.serial == "A2"]
    assert [(one.vendor, one.model, one.address, one.protocol) for one in listed] == [
        ("Aravis", "Fake", "127.0.0.1", "GigEVision")
    ]
    by_serial = {key: value for key, value in OPTIONS.items() if key != "address"} | {"serial": "A2"}
    camera = open_camera(by_serial, name="cam")
    assert camera.camera_name == "Aravis Fake A2"
    camera.close()
    with pytest.raises(NoCamera, match=r"cam: no camera with serial number B9 answers; there are: .*A2"):
        open_camera({**by_serial, "serial": "B9"}, name="cam")
