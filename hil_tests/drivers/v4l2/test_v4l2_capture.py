"""The capture thread and the camera over it, with a made-up stream in place of the kernel's.

What only a real driver shows (mapping, faults, unplugging) is tested in hil_tests/vm.
"""

from __future__ import annotations

import contextlib
import os
import threading
from collections import deque
from collections.abc import Iterator
from functools import partial
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest

from calib.geometry.mode import SensorMode
from drivers.errors import BadOptions, DriverError, NoCamera, NoFreshFrame, StreamFailed
from drivers.pixels import PictureFormat
from drivers.v4l2 import abi, find
from drivers.v4l2.camera import V4l2Camera, open_camera
from drivers.v4l2.node import Dequeued, Identity
from drivers.v4l2.settings import parse_options
from drivers.v4l2.stamps import StampRule
from drivers.values_set import ValuesSet
from hil_tests.drivers.v4l2.v4l2_sensor import TurnedClock
from hil_tests.left_behind import held
from hil_tests.waiting import NET_S, until

SIZE_PX = (16, 8)
START = abi.BUF_FLAG_TIMESTAMP_MONOTONIC | abi.BUF_FLAG_TSTAMP_SRC_SOE


class FakeNode:
    """A node whose frames a test puts in."""

    identity = Identity("fake", "Fake camera", "nowhere", 0)
    path = Path("/dev/video7")

    def __init__(self) -> None:
        self.ready = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_SEMAPHORE)
        self.waiting: deque[tuple[Dequeued, bytes | bytearray] | DriverError] = deque()
        self.queued: list[int] = []
        self.lock = threading.Lock()
        self.memory: dict[int, bytes | bytearray] = {}
        self.closed = False

    def fileno(self) -> int:
        return self.ready

    def put(self, what: tuple[Dequeued, bytes | bytearray] | DriverError) -> None:
        with self.lock:
            self.waiting.append(what)
            os.eventfd_write(self.ready, 1)

    def dequeue(self) -> Dequeued | None:
        with self.lock:
            with contextlib.suppress(BlockingIOError):
                os.eventfd_read(self.ready)
            if not self.waiting:
                return None
            what = self.waiting.popleft()
        if isinstance(what, DriverError):
            raise what
        self.memory[what[0].number] = what[1]
        return what[0]

    def bytes_of(self, buffer: Dequeued) -> memoryview:
        return memoryview(self.memory[buffer.number])

    def queue(self, index: int) -> None:
        self.queued.append(index)

    def check_there(self) -> None:
        pass


class FakeStream:
    """A stream over such a node."""

    def __init__(self) -> None:
        self.node = FakeNode()
        self.format = PictureFormat("GREY", SIZE_PX, SIZE_PX[0], SIZE_PX[0] * SIZE_PX[1])
        self.rate_hz = 25.0
        self.period_s = 0.04
        self.exposure_s: float | None = 0.01
        self.problems: list[object] = []
        self.sensor_mode = SensorMode(SIZE_PX)
        self.rate_known = True
        self.rule = StampRule(0.0)
        self.in_force = {"exposure_s": ValuesSet(0.01)}
        self.closed = False

    def close(self) -> None:
        self.closed = True

    def frame(
        self, sequence: int, stamp_s: float, level: int = 50, flags: int = START, length: int | None = None
    ) -> None:
        data = bytes([level]) * (SIZE_PX[0] * SIZE_PX[1] if length is None else length)
        self.node.put((Dequeued(sequence % 4, len(data), flags, sequence, stamp_s), data))


class Bench:
    """What opens: the streams in order, or the error that opening raises."""

    def __init__(self) -> None:
        self.clock = TurnedClock()
        self.streams: list[FakeStream] = []
        self.refusals: deque[DriverError] = deque()
        self.mode = SensorMode(SIZE_PX)

    def open(self, *ignored: object) -> FakeStream:
        if self.refusals:
            raise self.refusals.popleft()
        self.streams.append(FakeStream())
        self.streams[-1].sensor_mode = self.mode
        return self.streams[-1]


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Bench:
    bench = Bench()
    monkeypatch.setattr("drivers.v4l2.camera.Stream", bench.open)
    return bench


@pytest.fixture
def camera(bench: Bench) -> Iterator[V4l2Camera]:
    made = V4l2Camera(
        parse_options({"card": "Fake", "format": "GREY"}, "navcam_left"), "navcam_left", bench.clock
    )
    yield made
    made.close()


def has_good(camera: V4l2Camera, frames: int) -> bool:
    return camera.counters.good == frames


def test_a_frame_carries_sequence_window_and_picture(bench: Bench, camera: V4l2Camera) -> None:
    bench.clock.time_s = 100.03
    bench.streams[0].frame(5, 100.0, level=77)
    frame = camera.next_frame(99.9, NET_S)
    assert frame.sequence == 5 and frame.image.shape == SIZE_PX[::-1] and (frame.image == 77).all()
    assert frame.mid_exposure_s - frame.exposure_s / 2 == pytest.approx(100.0)
    assert frame.mid_exposure_s + frame.exposure_s / 2 == pytest.approx(100.03)
    assert frame.mid_uncertainty_s == pytest.approx(0.01) and frame.set_exposure_s == 0.01
    assert not frame.image.flags.writeable


def test_an_old_frame_is_never_given(bench: Bench, camera: V4l2Camera) -> None:
    bench.clock.time_s = 101.0
    bench.streams[0].frame(0, 100.0)
    until(lambda: camera.counters.good == 1, "good frames")
    with pytest.raises(
        NoFreshFrame, match=r"after the requested moment .* is frame 0, exposed 0.000 s before"
    ):
        camera.next_frame(100.0, 0.01)  # began at that very moment, not after it
    bench.streams[0].frame(1, 100.04)
    assert camera.next_frame(100.0, NET_S).sequence == 1


def test_the_newest_frame_is_given_not_the_first_that_fits(bench: Bench, camera: V4l2Camera) -> None:
    bench.clock.time_s = 100.4
    for n in range(10):
        bench.streams[0].frame(n, 100.0 + 0.04 * n)
    until(lambda: camera.counters.good == 10, "good frames")
    assert camera.next_frame(99.0, 0.0).sequence == 9


def test_a_frame_older_than_the_next_should_be_is_waited_past(bench: Bench, camera: V4l2Camera) -> None:
    bench.clock.time_s = 100.04
    bench.streams[0].frame(0, 100.0)
    assert camera.next_frame(99.0, NET_S).sequence == 0  # a period and 5 ms are allowed
    bench.clock.time_s = 100.046
    with pytest.raises(NoFreshFrame, match=r"the last good one is frame 0, 0\.046 s old"):
        camera.next_frame(99.0, 0.01)
    threading.Timer(0.05, lambda: bench.streams[0].frame(1, 100.045)).start()
    assert camera.next_frame(99.0, NET_S).sequence == 1


def test_a_broken_jpeg_is_damage_that_shows_when_it_is_decoded(bench: Bench) -> None:
    whole = cv2.imencode(".jpg", np.full((8, 16), 90, np.uint8))[1].tobytes()
    broken = whole[:2] + b"\0" * 40 + b"\xff\xd9"
    bench.clock.time_s = 100.03
    camera = V4l2Camera(parse_options({"card": "Fake", "format": "MJPG"}, "eye"), "eye", bench.clock)
    try:
        stream = bench.streams[0]
        stream.format = PictureFormat("MJPG", SIZE_PX, 0, 4096)
        stream.node.put((Dequeued(0, len(broken), START, 0, 100.0), broken))
        with pytest.raises(NoFreshFrame, match="1 came damaged"):
            camera.next_frame(99.9, 0.5)
        stream.node.put((Dequeued(1, len(whole), START, 1, 100.02), whole))
        assert abs(int(camera.next_frame(99.9, NET_S).image.mean()) - 90) <= 2
    finally:
        camera.close()
    assert (camera.counters.good, camera.counters.damaged) == (1, 1)


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        ({"flags": START | abi.BUF_FLAG_ERROR}, "its driver marks it as damaged"),
        ({"length": 100}, "100 bytes where 128 are expected"),
        ({"stamp_s": 100.2}, "its stamp is 100.0 ms ahead of the clock"),
        ({"stamp_s": 99.0}, "its stamp is 1000.0 ms before the last frame's"),
        ({"flags": 0}, "its stamp is not of the monotonic clock"),
    ],
)
def test_a_damaged_frame_is_refused_counted_and_given_back(
    bench: Bench, camera: V4l2Camera, damage: dict[str, float], words: str
) -> None:
    bench.clock.time_s = 100.1
    bench.streams[0].frame(0, 100.0)
    until(lambda: camera.counters.good == 1, "good frames")
    bench.streams[0].frame(1, **{"stamp_s": 100.04, **damage})  # type: ignore[arg-type]
    until(lambda: camera.counters.damaged == 1, "the damaged one")
    assert camera.counters.last_damage == words
    until(
        lambda: bench.streams[0].node.queued == [1], "its buffer is given back"
    )  # and frame 0 is still held
    bench.clock.time_s = 100.04
    assert camera.next_frame(0.0, 0.0).sequence == 0


def test_dropped_and_late_frames_are_counted(bench: Bench, camera: V4l2Camera) -> None:
    bench.clock.time_s = 100.01
    bench.streams[0].frame(0, 100.0)
    until(lambda: camera.counters.good == 1, "good frames")
    bench.clock.time_s = 100.2
    bench.streams[0].frame(4, 100.1)
    until(lambda: camera.counters.good == 2, "good frames")
    counters = camera.counters
    assert (counters.dropped, counters.late) == (3, 1)


def test_a_lost_camera_is_told_at_once_and_opened_again(bench: Bench, camera: V4l2Camera) -> None:
    bench.clock.time_s = 100.1
    bench.streams[0].frame(41, 100.0)
    assert camera.next_frame(0.0, NET_S).sequence == 41
    bench.refusals += [NoCamera("/dev/v4l/by-id/x is not there")] * 2
    bench.streams[0].node.put(NoCamera("/dev/video7 is gone", device="navcam_left"))
    until(lambda: camera.lost, "the loss")
    with pytest.raises(NoCamera):
        camera.next_frame(0.0, NET_S)
    until(lambda: len(bench.streams) == 2, "it is opened again")
    assert bench.streams[0].closed
    until(lambda: not camera.lost, "it is back")
    bench.clock.time_s = 103.0
    bench.streams[1].frame(0, 102.99)
    frame = camera.next_frame(102.0, NET_S)
    assert frame.sequence > 41 and frame.driver_sequence == 0 and frame.stream == 2
    assert camera.counters.reopened == 1


def test_a_camera_that_comes_back_in_another_mode_is_not_taken(bench: Bench, camera: V4l2Camera) -> None:
    was, bench.mode = bench.mode, SensorMode(SIZE_PX, flip=(True, False))
    bench.streams[0].node.put(StreamFailed("/dev/video7 does not give a frame: Input/output error"))
    until(lambda: "it came back with" in camera.lost, "the refusal")
    assert camera.lost == (
        "navcam_left: it came back with an unknown part of its sensor as 16x8 px, flip horizontal "
        "where it had an unknown part of its sensor as 16x8 px"
    )
    bench.mode = was
    until(lambda: not camera.lost, "the camera as it was")
    assert all(stream.closed for stream in bench.streams[:-1]) and camera.info.sensor_mode == was


def test_a_stream_is_given_back_its_own_buffers_only(bench: Bench, camera: V4l2Camera) -> None:
    bench.clock.time_s = 100.01
    bench.streams[0].frame(2, 100.0)
    until(lambda: camera.counters.good == 1, "good frames")
    bench.streams[0].node.put(StreamFailed("/dev/video7 does not give a frame: Input/output error"))
    until(lambda: len(bench.streams) == 2, "it is opened again")
    for index in (0, 1):
        bench.clock.time_s += 0.04
        bench.streams[1].frame(index, bench.clock.time_s - 0.01)
        until(partial(has_good, camera, 2 + index), "good frames")
    until(lambda: bench.streams[1].node.queued, "its buffers")
    assert bench.streams[1].node.queued == [0]  # and no buffer 2, which it has never filled


def test_a_closed_camera_gives_no_frame_though_one_had_come(bench: Bench, camera: V4l2Camera) -> None:
    bench.clock.time_s = 100.01
    bench.streams[0].frame(0, 100.0)
    until(lambda: camera.counters.good == 1, "good frames")
    camera.close()
    with pytest.raises(NoFreshFrame):
        camera.next_frame(0.0, 0.0)
    assert camera.newest is None and not camera.recent_times()  # their memory is unmapped


def test_the_count_grows_when_the_drivers_count_begins_again(bench: Bench, camera: V4l2Camera) -> None:
    sequences = []
    for index, count in enumerate((2**32 - 1, 0, 1, 0)):
        bench.clock.time_s = 100.01 + 0.04 * index
        bench.streams[0].frame(count, 100.0 + 0.04 * index)
        until(partial(has_good, camera, index + 1), "good frames")
        sequences.append(camera.next_frame(0.0, 0.0).sequence)
    assert all(b > a for a, b in pairwise(sequences))


def test_nothing_is_left_after_closing(bench: Bench) -> None:
    before = held()
    options = parse_options({"card": "Fake", "format": "GREY"}, "c")
    for _ in range(20):
        V4l2Camera(options, "c", bench.clock).close()
    for stream in bench.streams:
        assert stream.closed
        os.close(stream.node.ready)
    assert held() <= before


def test_closing_does_not_wait_for_ever_for_a_driver_that_hangs(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("drivers.newest.CLOSE_PATIENCE_S", 0.05)
    before = held()
    camera = V4l2Camera(parse_options({"card": "Fake", "format": "GREY"}, "eye"), "eye", bench.clock)
    hangs, back = threading.Event(), threading.Event()

    def hang(index: int) -> None:
        hangs.set()
        assert back.wait(NET_S)

    monkeypatch.setattr(bench.streams[0].node, "queue", hang)
    bench.streams[0].frame(0, 100.0)
    bench.streams[0].frame(1, 100.04)  # the first one's buffer goes back, and the driver does not return
    assert hangs.wait(NET_S)
    camera.close()
    assert "eye: its driver hangs" in caplog.text and not bench.streams[0].closed
    back.set()
    until(lambda: set(threading.enumerate()) <= before, "the thread's end")
    assert bench.streams[0].closed, "when the driver came back, the camera was let go"
    os.close(bench.streams[0].node.ready)
    assert held() <= before


def test_only_the_newest_frames_buffer_is_held(bench: Bench, camera: V4l2Camera) -> None:
    bench.clock.time_s = 101.98
    for n in range(50):
        bench.streams[0].frame(n, 100.0 + 0.04 * n, level=n)
    until(lambda: len(bench.streams[0].node.queued) == 49, "all but one")
    assert bench.streams[0].node.queued == [n % 4 for n in range(49)]
    frame = camera.next_frame(0.0, 0.0)
    assert frame.sequence == 49 and (frame.image == 49).all()


def test_a_given_frame_does_not_change_with_its_buffer(bench: Bench, camera: V4l2Camera) -> None:
    bench.clock.time_s = 200.0
    memory = bytearray([1]) * 128
    for n in range(2):
        memory[:] = bytes([n + 1]) * 128
        bench.streams[0].node.put((Dequeued(0, 128, START, n, 100.0 + 0.04 * n), memory))
        frame = camera.next_frame(100.0 + 0.04 * n - 0.01, NET_S)
        memory[:] = bytes([99]) * 128
        assert (frame.image == n + 1).all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "'device', 'card' or 'bus' is expected"),
        ({"device": "/dev/video0"}, "/dev/video0 is a number that changes when cameras are plugged in"),
        ({"device": "/dev/v4l/by-id/a", "card": "b"}, "options.device: stands beside card or bus"),
        ({"card": "a", "format": "H264"}, "options.format: 'H264', which this driver does not know"),
        (
            {"card": "a", "size_px": [640]},
            r"options.size_px: \[640\] where 2 whole numbers from 1 to 16384 are expected",
        ),
        ({"card": "a", "rate_hz": float("nan")}, "options.rate_hz: nan where"),
        ({"card": "a", "buffers": 1}, "options.buffers: 1 where an integer from 3 to 32 is expected"),
        (
            {"card": "a", "auto_exposure": {"shortest_s": 0.1}, "exposure_s": 0.01},
            "options.auto_exposure.shortest_s: 0.1 s, expected less than longest_s",
        ),
    ],
)
def test_bad_options_are_told_in_one_line(options: dict[str, object], message: str) -> None:
    with pytest.raises(BadOptions, match=message) as caught:
        open_camera(options, name="navcam_left")
    assert str(caught.value).startswith("navcam_left: ") and "\n" not in str(caught.value)


def test_a_bare_number_is_refused_with_the_stable_link(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(find, "LINKS", tmp_path)
    with pytest.raises(BadOptions, match=r"; give a link under /dev/v4l/by-id, or 'card' and 'bus' \("):
        open_camera({"device": "/dev/video9"}, name="eye")
    (tmp_path / "by-path").mkdir()
    link = tmp_path / "by-path" / "usb-0:1"
    link.symlink_to("/dev/video9")
    (tmp_path / "by-path" / "usb-0:2").symlink_to("/dev/video8")
    with pytest.raises(BadOptions, match=rf"; give {link} \("):
        open_camera({"device": "/dev/video9"}, name="eye")
