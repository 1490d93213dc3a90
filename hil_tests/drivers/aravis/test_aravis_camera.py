"""The driver ``aravis`` on a GigE Vision camera in memory, whose true exposures are known, on loopback."""

from __future__ import annotations

import logging
import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from drivers.aravis import library
from drivers.aravis.camera import AravisCamera, open_camera
from drivers.errors import DriverError, NoFreshFrame, UnsupportedFormat
from drivers.newest import TimedFrame
from hil_tests.drivers.aravis.gige_camera import GigeCamera
from hil_tests.left_behind import held
from hil_tests.waiting import NET_S, until

pytestmark = pytest.mark.skipif(
    not library.installed(), reason=f"libaravis-0.8 is not installed: {library.INSTALL}"
)

ADDRESS = f"127.{100 + os.getpid() // 65536 % 100}.{os.getpid() // 256 % 256}.{1 + os.getpid() % 254}"
OPTIONS: dict[str, Any] = {
    "address": ADDRESS, "size_px": [64, 48], "rate_hz": 50, "exposure_s": 0.005, "stamp": "start",
}  # fmt: skip
ROUNDING_S = 1e-6
BUSY_S = 0.2  # by which a busy machine may send even the quickest frame too late
OPENED: list[AravisCamera] = []
"""Closed after each test, failed or not: the next one would share its device with them."""


@pytest.fixture
def device() -> Iterator[GigeCamera]:
    camera = GigeCamera(ADDRESS, clock_ahead_s=1234.5)
    yield camera
    while OPENED:
        OPENED.pop().close()
    camera.unplug()


def opened(**options: Any) -> AravisCamera:
    OPENED.append(open_camera({**OPTIONS, **options}, name="cam"))
    return OPENED[-1]


def truly_inside(frame: TimedFrame, device: GigeCamera) -> bool:
    """Whether the true exposure lay in the window that the frame states, and it is the frame's picture."""
    began_s, ended_s = device.exposed_s[frame.driver_sequence - 1]
    assert set(frame.image.ravel().tolist()) == {frame.driver_sequence % 251}
    window_end_s = frame.exposure_began_s + frame.exposure_s
    return frame.exposure_began_s <= began_s + ROUNDING_S and ended_s <= window_end_s + ROUNDING_S


def test_a_stream_hears_no_packet_that_is_not_sent_to_it(device: GigeCamera) -> None:
    """A packet socket, which root may have, hears other cameras until it is filtered."""
    try:
        socket.socket(socket.AF_PACKET, socket.SOCK_RAW).close()
    except PermissionError:
        pytest.skip("this user may have no packet sockets, so that Aravis opens none")
    opened().next_frame(time.monotonic(), NET_S)
    inodes = {line.split()[-1] for line in Path("/proc/self/net/packet").read_text().splitlines()[1:]}
    mine = {str(one[1]) for one in held() if isinstance(one, tuple)}
    assert not {f"socket:[{inode}]" for inode in inodes} & mine


def test_a_frame_is_exposed_in_the_window_that_it_states(device: GigeCamera) -> None:
    camera = opened()
    for _ in range(10):
        asked_s = time.monotonic()
        frame = camera.next_frame(asked_s, NET_S)
        assert device.exposed_s[frame.driver_sequence - 1][0] >= asked_s
        assert frame.exposure_began_s > asked_s
        assert truly_inside(frame, device)
        assert not frame.image.flags.writeable
    assert camera.info.size_px == (64, 48)
    assert camera.info.period_s == pytest.approx(0.02)
    camera.close()


def test_a_clock_that_cannot_be_read_makes_the_window_longer() -> None:
    device = GigeCamera(ADDRESS, clock_readable=False, clock_ahead_s=-77.0)
    try:
        camera = opened(stamp="either", margin_s=BUSY_S)
        frames = [camera.next_frame(time.monotonic(), NET_S) for _ in range(5)]
        assert all(truly_inside(frame, device) for frame in frames)
        assert frames[0].driver_sequence > 4  # the first ones only showed how soon a frame may come
        camera.close()
    finally:
        device.unplug()


def test_frames_that_never_came_are_counted_by_their_numbers(device: GigeCamera) -> None:
    camera = opened()
    first = camera.next_frame(time.monotonic(), NET_S)
    before = camera.counters.dropped
    gone = device.frames + 20
    device.lose = lambda frame, packet: gone <= frame < gone + 3
    last = first
    while last.driver_sequence <= gone + 3:
        last = camera.next_frame(time.monotonic(), NET_S)
    assert camera.counters.dropped == before + 3
    grew = last.sequence - first.sequence  # gaps are gaps of our count too
    assert grew == last.driver_sequence - first.driver_sequence
    camera.close()


@pytest.mark.parametrize("sends_us", [-4000.0, float("nan")])
def test_an_impossible_exposure_time_is_left_out_and_logged_once(
    device: GigeCamera, sends_us: float, caplog: pytest.LogCaptureFixture
) -> None:
    device.sends_us = sends_us
    with caplog.at_level(logging.WARNING):
        camera = opened(stamp="either")
        for _ in range(3):
            frame = camera.next_frame(time.monotonic(), NET_S)
            assert truly_inside(frame, device)
            assert frame.set_exposure_s == pytest.approx(0.005), "as it was set"
    (told,) = [record.getMessage() for record in caplog.records if "cannot be" in record.getMessage()]
    assert told == (
        f"cam: a frame came with exposure_s {1e-6 * sends_us:.6g}, which cannot be; such values are left out"
    )


def test_the_input_line_exposes_and_nothing_else_does(device: GigeCamera) -> None:
    camera = opened(rate_hz=None, trigger_source="Line1", trigger="both eyes")
    assert camera.info.trigger == "both eyes"
    with pytest.raises(NoFreshFrame, match="none came at all"):
        camera.next_frame(0.0, 0.1)
    assert device.frames == 0
    asked_s = time.monotonic()
    time.sleep(0.02)  # more than the clock's uncertainty: else the frame may be from before
    device.pulse()
    frame = camera.next_frame(asked_s, NET_S)
    assert frame.driver_sequence == device.frames == 1
    assert truly_inside(frame, device)
    with pytest.raises(NoFreshFrame):
        camera.next_frame(time.monotonic(), 0.05)
    camera.close()


def test_a_clock_that_is_set_while_it_streams_lets_no_old_frame_pass(device: GigeCamera) -> None:
    camera = opened()
    camera.next_frame(time.monotonic(), NET_S)
    device.clock_ahead_s += 0.5  # frames now look half a second younger than they are
    asked_s = time.monotonic()
    try:
        frame = camera.next_frame(asked_s, NET_S)
    except DriverError:  # lost, and opened again
        until(lambda: camera.counters.reopened, "opened again")
        frame = camera.next_frame(asked_s, NET_S)
    assert device.exposed_s[frame.driver_sequence - 1][0] >= asked_s
    camera.close()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"format": "BayerRG8"}, "has no format BayerRG8; it has Mono8"),
        ({"size_px": [4096, 48]}, r"does not take 4096x48 px .* width 16 to 2048"),
        ({"rate_hz": None, "trigger_source": "Line7"}, "no trigger source Line7 .* it has Software, Line1"),
        ({"rate_hz": 300, "exposure_s": 0.001}, "has no 300 Hz here; its nearest is 200"),
    ],
)
def test_what_the_camera_does_not_have_is_refused_with_what_it_has(
    device: GigeCamera, options: dict[str, Any], words: str
) -> None:
    with pytest.raises(UnsupportedFormat, match=words):
        opened(**options)


WITHOUT_DESCRIPTORS = """
import os, resource
from drivers.aravis import find, library
from drivers.aravis.settings import AravisOptions
from drivers.errors import StreamFailed
library.library()
resource.setrlimit(resource.RLIMIT_NOFILE, (64, 64))
taken = []
for left in (0, 1, 2, 5):
    try:
        while True:
            taken.append(os.open(os.devnull, os.O_RDONLY))
    except OSError:
        pass
    for _ in range(left):
        os.close(taken.pop())
    for opens in (find.list_cameras, lambda: find.open_camera(AravisOptions(address="ADDRESS"), "cam")):
        try:
            print("opened", opens())
        except StreamFailed as error:
            print(error)
"""


def test_without_free_descriptors_a_camera_is_refused_and_glib_ends_no_process(device: GigeCamera) -> None:
    program = WITHOUT_DESCRIPTORS.replace("ADDRESS", ADDRESS)
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=NET_S)
    assert (done.returncode, done.stderr) == (0, "")
    refusals = done.stdout.splitlines()
    assert len(refusals) == 8
    for refusal in refusals:
        assert "of at most 64 files and connections are open in this process" in refusal
