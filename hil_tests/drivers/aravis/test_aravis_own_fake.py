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
from drivers.values_set import SETTLE_FRAMES
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

    def start(serial: str, lost: float = 0.0) -> subprocess.Popen[str]:
        program = [sys.executable, str(Path(__file__).with_name("aravis_fake.py")), serial, str(lost)]
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
    triggered = open_camera({**OPTIONS, "rate_hz": None, "trigger_source": "Software"}, name="cam")
    numbers = [frame.driver_sequence for frame in taken(triggered, 3)]
    assert numbers == [numbers[0], numbers[0] + 1, numbers[0] + 2]
    triggered.close()


def test_its_settings_change_as_it_streams(fake: Start) -> None:
    fake("A6")
    camera = open_camera({**OPTIONS, "gain": 2}, name="cam")
    exposure, gain = camera.settings()
    assert (exposure.name, exposure.value, exposure.maximum) == ("exposure_s", 0.01, 1 / 40)
    assert (gain.name, gain.value, gain.minimum, gain.maximum) == ("gain", 2.0, 0.0, 10.0)
    assert taken(camera, 1)[0].settings == {"exposure_s": 0.01, "gain": 2.0}
    (note,) = camera.adjust({"gain": 5.5, "exposure_s": 0.02})
    assert note == "cam: gain is 5 where 5.5 was asked for: the camera's nearest"
    told = taken(camera, SETTLE_FRAMES + 2)
    assert told[0].settings == {"exposure_s": None, "gain": None}
    assert told[-1].settings == {"exposure_s": 0.02, "gain": 5.0}
    camera.close()


def test_it_is_found_by_its_serial_number_and_by_its_name(fake: Start) -> None:
    fake("A2")
    listed = [one for one in find.list_cameras() if one.serial == "A2"]
    assert [(one.vendor, one.model, one.address, one.protocol) for one in listed] == [
        ("Aravis", "Fake", "127.0.0.1", "GigEVision")
    ]
    by_serial = {key: value for key, value in OPTIONS.items() if key != "address"} | {"serial": "A2"}
    camera = open_camera(by_serial, name="cam")
    assert camera.capture.words == "Aravis Fake A2"
    camera.close()
    with pytest.raises(NoCamera, match=r"cam: no camera with serial number B9 answers; there are: .*A2"):
        open_camera({**by_serial, "serial": "B9"}, name="cam")


def test_of_frames_with_lost_packets_none_is_delivered(fake: Start) -> None:
    fake("A3", 0.003)  # of 57 packets a frame
    camera = open_camera(OPTIONS, name="cam")
    until(lambda: all(is_ramp(frame) for frame in taken(camera, 5)) and camera.counters.damaged > 3, "losses")
    assert camera.counters.good > 5
    camera.close()


def test_a_fake_that_is_killed_is_reported_and_comes_back(fake: Start) -> None:
    process = fake("A4")
    camera = open_camera(OPTIONS, name="cam")
    (last,) = taken(camera, 1)
    process.kill()
    until(lambda: camera.capture.newest.lost, "the loss")
    with pytest.raises(NoCamera):
        camera.next_frame(0.0, NET_S)
    fake("A4")
    until(lambda: not camera.capture.newest.lost, "the return")
    (frame,) = taken(camera, 1)
    assert is_ramp(frame)
    assert frame.sequence > last.sequence
    camera.close()


@pytest.mark.long(1, "two thousand frames among lost packets, and three kills")
def test_two_thousand_frames_among_losses_and_kills(fake: Start) -> None:
    process = fake("A5", 0.001)
    camera = open_camera(OPTIONS, name="cam")
    count = 0
    for kill in range(4):
        while count < 500 * (kill + 1):
            asked_s = time.monotonic()
            frame = camera.next_frame(asked_s, NET_S)
            assert is_ramp(frame)
            assert true_stamp_s(frame) >= asked_s - 0.0005
            count += 1
        if kill < 3:
            process.kill()
            until(lambda: camera.capture.newest.lost, "the loss")
            process = fake("A5", 0.001)
            until(lambda: not camera.capture.newest.lost, "the return")
    assert camera.counters.reopened == 3
    assert camera.counters.damaged > 20
    camera.close()
