"""The driver ``aravis`` on a GigE Vision camera in memory, whose true exposures are known, on loopback."""

from __future__ import annotations

import logging
import os
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from drivers.aravis import library
from drivers.aravis.camera import AravisCamera, open_camera
from drivers.errors import DriverError, NoCamera, NoFreshFrame, UnsupportedFormat
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


def test_a_frame_is_exposed_after_the_asked_moment_in_the_window_that_it_states(device: GigeCamera) -> None:
    camera = opened()
    for _ in range(10):
        asked_s = time.monotonic()
        frame = camera.next_frame(asked_s, NET_S)
        assert device.exposed_s[frame.driver_sequence - 1][0] >= asked_s
        assert frame.exposure_began_s > asked_s
        assert truly_inside(frame, device)
        assert not frame.image.flags.writeable
    assert camera.size_px == (64, 48)
    assert camera.period_s == pytest.approx(0.02)
    camera.close()


def test_a_clock_that_cannot_be_read_makes_the_window_longer_and_still_true() -> None:
    device = GigeCamera(ADDRESS, clock_readable=False, clock_ahead_s=-77.0)
    try:
        camera = opened(stamp="either")
        frames = [camera.next_frame(time.monotonic(), NET_S) for _ in range(5)]
        assert all(truly_inside(frame, device) for frame in frames)
        assert frames[0].driver_sequence > 4  # the first ones only showed how soon a frame may come
        camera.close()
    finally:
        device.unplug()


def test_each_frame_brings_its_own_exposure_time(device: GigeCamera) -> None:
    camera = opened(exposure_s=0.003)
    frame = camera.next_frame(time.monotonic(), NET_S)
    assert frame.set_exposure_s == pytest.approx(0.003)
    assert frame.settings == {"exposure_s": frame.set_exposure_s}
    device._set_float(0x3000, 6000.0)  # another program, or an automatic of the camera
    until(lambda: camera.next_frame(time.monotonic(), NET_S).set_exposure_s == pytest.approx(0.006), "6 ms")
    camera.close()


def test_a_frame_that_lost_a_packet_is_counted_and_never_delivered(device: GigeCamera) -> None:
    device.lose = lambda frame, packet: frame % 2 == 0 and packet == 2
    camera = opened()
    frames = [camera.next_frame(time.monotonic(), NET_S) for _ in range(6)]
    assert all(frame.driver_sequence % 2 for frame in frames)
    assert all(truly_inside(frame, device) for frame in frames)
    until(lambda: camera.counters.damaged >= 5, "damaged frames counted")
    assert "packets" in camera.counters.last_damage
    device.lose = lambda frame, packet: True
    with pytest.raises(NoFreshFrame, match="no frame exposed after"):
        camera.next_frame(time.monotonic(), 0.2)
    camera.close()


def test_frames_that_never_came_are_counted_by_their_numbers(device: GigeCamera) -> None:
    camera = opened()
    first = camera.next_frame(time.monotonic(), NET_S)
    before = camera.counters.dropped
    gone = device.frames + 20
    device.lose = lambda frame, packet: gone <= frame < gone + 3
    last = until(
        lambda: (f := camera.next_frame(time.monotonic(), NET_S)).driver_sequence > gone + 3 and f, "more"
    )
    assert camera.counters.dropped == before + 3
    grew = last.sequence - first.sequence  # gaps are gaps of our count too
    assert grew == last.driver_sequence - first.driver_sequence
    camera.close()


def test_the_software_trigger_exposes_when_a_frame_is_asked_for(device: GigeCamera) -> None:
    camera = opened(rate_hz=None, trigger_source="Software")
    with pytest.raises(NoFreshFrame):
        camera.next_frame(time.monotonic() + 3600.0, 0.05)  # a triggered frame is no proof of the future
    until(lambda: device.frames == 1, "the frame of that request")
    before = device.frames
    for count in range(1, 6):
        asked_s = time.monotonic()
        frame = camera.next_frame(asked_s, NET_S)
        assert device.frames == before + count
        assert device.exposed_s[frame.driver_sequence - 1][0] >= asked_s
        assert truly_inside(frame, device)
    camera.close()


@pytest.fixture(params=[False, True], ids=["clock not readable", "clock readable"])
def either_clock(request: pytest.FixtureRequest) -> Iterator[GigeCamera]:
    camera = GigeCamera(ADDRESS, clock_readable=request.param, clock_ahead_s=-55.0)
    yield camera
    while OPENED:
        OPENED.pop().close()
    camera.unplug()


def fresh(camera: AravisCamera, device: GigeCamera) -> TimedFrame:
    """The frame of a request, which was truly exposed after it."""
    asked_s = time.monotonic()
    frame = camera.next_frame(asked_s, NET_S)
    assert device.exposed_s[frame.driver_sequence - 1][0] >= asked_s
    assert truly_inside(frame, device)
    return frame


@pytest.mark.parametrize("how", ["ignored", "lost", "late"])
def test_after_a_trigger_without_a_frame_the_next_request_has_its_own(
    either_clock: GigeCamera, how: str
) -> None:
    device = either_clock
    camera = opened(rate_hz=None, trigger_source="Software")
    for _ in range(2):
        gone = fresh(camera, device).driver_sequence + 1
        device.ignores = int(how == "ignored")
        device.delay_s = 0.3 if how == "late" else 0.001
        device.lose = lambda frame, packet, gone=gone: how == "lost" and frame == gone  # type: ignore[misc]
        with pytest.raises(NoFreshFrame):
            camera.next_frame(time.monotonic(), 0.05)
        device.delay_s = 0.001
        fresh(camera, device)
    assert fresh(camera, device).driver_sequence == device.frames


def test_a_request_with_time_left_triggers_again_after_a_damaged_frame(either_clock: GigeCamera) -> None:
    device = either_clock
    camera = opened(rate_hz=None, trigger_source="Software")
    gone = fresh(camera, device).driver_sequence + 1
    device.lose = lambda frame, packet: frame == gone
    assert fresh(camera, device).driver_sequence > gone


def test_a_request_that_is_too_short_to_be_sure_of_its_frame_triggers_none() -> None:
    device = GigeCamera(ADDRESS, clock_readable=False)
    try:
        camera = opened(rate_hz=None, trigger_source="Software")
        device.ignores = 1
        for _ in range(3):  # the first one's frame may still come
            with pytest.raises(NoFreshFrame):
                camera.next_frame(time.monotonic(), 0.01)
        assert device.triggers == 1
        fresh(camera, device)
        camera.close()
    finally:
        device.unplug()


def test_a_frame_whose_number_steps_back_is_given_no_triggers_moment() -> None:
    device = GigeCamera(ADDRESS, clock_readable=False)
    try:
        camera = opened(rate_hz=None, trigger_source="Software")
        fresh(camera, device)
        device.frames -= 1  # the camera gives the same number again: a frame twice, or another one
        device.exposed_s.pop()
        with pytest.raises(NoFreshFrame):
            camera.next_frame(time.monotonic(), 0.1)
        fresh(camera, device)
        camera.close()
    finally:
        device.unplug()


def test_a_request_at_the_moment_of_the_return_waits_for_its_frame(device: GigeCamera) -> None:
    camera = opened(rate_hz=None, trigger_source="Software")
    fresh(camera, device)
    newest, frames = camera.capture.newest, []
    returned, triggers = newest.come_back, device.triggers

    def ask() -> None:
        with suppress(NoFreshFrame):
            frames.append(fresh(camera, device))
        ended.set()

    def come_back() -> None:
        returned()
        asking.start()
        until(lambda: ended.is_set() or device.triggers > triggers, "the trigger of that request")

    ended, asking = threading.Event(), threading.Thread(target=ask, daemon=True)
    newest.come_back = come_back  # type: ignore[method-assign]
    camera.capture._there().lost.set()  # as Aravis tells it
    until(ended.is_set, "the end of that request")
    assert len(frames) == 1


@pytest.mark.parametrize("sends_us", [-4000.0, 0.0, float("nan"), float("inf"), 1e12])
def test_an_exposure_time_that_cannot_be_is_left_out_and_told_once(
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
    assert camera.trigger == "both eyes"
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


def test_an_unplugged_camera_is_reported_and_comes_back(device: GigeCamera) -> None:
    camera = opened()
    last = camera.next_frame(time.monotonic(), NET_S)
    device.unplug()
    until(lambda: camera.capture.newest.lost, "the loss")
    with pytest.raises(NoCamera) as lost:
        camera.next_frame(0.0, NET_S)  # an old frame would do, and there is none
    assert "cam: it gave no frame for" in str(lost.value)
    again = GigeCamera(ADDRESS, clock_ahead_s=9.0)  # its count and its clock begin anew
    until(lambda: not camera.capture.newest.lost, "the return")
    frame = camera.next_frame(time.monotonic(), NET_S)
    assert truly_inside(frame, again)
    assert frame.sequence > last.sequence
    assert camera.counters.reopened == 1
    camera.close()
    again.unplug()


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


def test_a_feature_that_the_camera_lacks_is_a_problem_that_is_told(device: GigeCamera) -> None:
    camera = opened(features={"NoSuchThing": 3, "ChunkModeActive": False}, gain=2.0)
    assert [problem.split(":")[0] for problem in camera.capture.problems] == [
        "feature NoSuchThing is not set to 3",
        "the camera has no control for gain; it stays as it is",
    ]
    assert camera.next_frame(time.monotonic(), NET_S).set_exposure_s == 0.005
    camera.close()
