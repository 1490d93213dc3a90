"""Stamps, rates and freshness on the kernel's vivid. Bounds are wide: the machine below is shared."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest

from drivers.errors import NoFreshFrame
from drivers.v4l2.camera import V4l2Camera, open_camera
from drivers.v4l2.pairing import Pairing

from .conftest import options

PERIOD_S = 0.04


def test_stamps_follow_the_clock(camera: V4l2Camera) -> None:
    delays_s = []
    for _ in range(25):
        frame = camera.next_frame(time.monotonic(), 5.0)
        assert frame.stamp_s <= frame.received_s
        assert frame.mid_exposure_s + frame.exposure_s / 2 <= frame.received_s + 1e-6
        delays_s.append(frame.received_s - frame.stamp_s)
    assert min(delays_s) < PERIOD_S  # not the median: the machine below may hold some up


def test_stamps_are_a_period_apart(camera: V4l2Camera) -> None:
    first = camera.next_frame(time.monotonic(), 5.0)
    frame = first
    while frame.driver_sequence < first.driver_sequence + 50:
        frame = camera.next_frame(frame.mid_exposure_s, 5.0)
    counted = frame.driver_sequence - first.driver_sequence
    assert (frame.stamp_s - first.stamp_s) / counted == pytest.approx(
        PERIOD_S, rel=0.05
    )  # gaps do not matter


def test_stamps_in_the_future_are_refused() -> None:
    # vivid's stamps "at the end of the frame" lie 0.9 periods ahead of the clock.
    camera = open_camera(options(controls={"timestamp_source": "end_of_frame"}), name="left")
    try:
        with pytest.raises(NoFreshFrame, match=r"came damaged \(its stamp is .* ms ahead of the clock\)"):
            camera.next_frame(time.monotonic(), 1.0)
    finally:
        camera.close()


def test_no_frame_is_older_than_asked(camera: V4l2Camera) -> None:
    for pause_s in (0.0, 0.01, 0.3, 1.0):
        time.sleep(pause_s)
        asked_s = time.monotonic()
        frame = camera.next_frame(asked_s, 5.0)
        assert frame.stamp_s > asked_s
        assert frame.mid_exposure_s - frame.exposure_s / 2 > asked_s


def test_what_came_instead_is_told(camera: V4l2Camera) -> None:
    camera.next_frame(0.0, 5.0)
    with pytest.raises(NoFreshFrame, match=r"the last good one is frame \d+, exposed 3\d\.\d+ s before"):
        camera.next_frame(time.monotonic() + 35.0, 0.1)


FRAMES_OF_A_FULL_RING = 6
"""A gap of the reader's making needs all eight buffers full, so at least so many frames come late with it.
A gap without them is vivid's own: it skips frames while buffers are free when the machine below stalls."""


def test_two_cameras_stream_on_while_the_consumer_sleeps_and_computes() -> None:
    cameras = [open_camera(options(index), name=f"eye{index}") for index in range(2)]
    try:
        for camera in cameras:
            camera.next_frame(time.monotonic(), 5.0)
        before = [camera.counters for camera in cameras]
        time.sleep(1.5)
        until_s = time.monotonic() + 1.5
        while time.monotonic() < until_s:
            np.linalg.svd(np.random.default_rng(1).standard_normal((60, 60)))
        for camera, counted in zip(cameras, before, strict=True):
            counters = camera.counters
            assert counters.good - counted.good > 20
            assert counters.damaged == counted.damaged and counters.reopened == 0
            if counters.dropped > counted.dropped:
                assert counters.late - counted.late < FRAMES_OF_A_FULL_RING
    finally:
        for camera in cameras:
            camera.close()


def test_two_free_running_cameras_are_paired() -> None:
    cameras = [open_camera(options(index), name=f"eye{index}") for index in range(2)]
    pairing = Pairing(PERIOD_S)
    pairs = []
    try:
        after_s = [time.monotonic()] * 2
        while len(pairs) < 20:
            for index, add in enumerate((pairing.add_left, pairing.add_right)):
                frame = cameras[index].next_frame(after_s[index], 5.0)
                after_s[index] = frame.mid_exposure_s
                if pair := add(frame):
                    pairs.append(pair)
    finally:
        for camera in cameras:
            camera.close()
    assert max(abs(pair.dt_s) for pair in pairs) <= PERIOD_S / 2 + 0.002
    assert len({pair.left.sequence for pair in pairs}) == len({pair.right.sequence for pair in pairs}) == 20


def test_closing_ends_a_waiting_call(camera: V4l2Camera) -> None:
    told: list[BaseException] = []

    def wait() -> None:
        try:
            camera.next_frame(time.monotonic() + 100, 30.0)
        except NoFreshFrame as error:
            told.append(error)

    thread = threading.Thread(target=wait)
    thread.start()
    time.sleep(0.1)
    camera.close()
    thread.join(10.0)
    assert told and not thread.is_alive()
