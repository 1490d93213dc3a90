"""Stamps, rates and freshness on the kernel's vivid. Bounds are wide where computing takes time."""

from __future__ import annotations

import os
import subprocess
import time

import numpy as np
import pytest

from drivers.errors import NoFreshFrame
from drivers.v4l2.camera import V4l2Camera, open_camera
from drivers.v4l2.settings import CameraOptions

from .conftest import RATE_HZ, TURNED_CLOCK, options

PERIOD_S = 0.04


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


BUFFERS = CameraOptions(card="any").buffers
FRAMES_OF_A_FULL_RING = BUFFERS - 2
"""A gap of the reader's making needs all buffers full, so at least so many frames come late with it. A gap
without them is vivid's own: it skips frames while buffers are free when the machine below stalls."""


@pytest.mark.parametrize("size_px", [(640, 480), (1280, 720)])  # vivid's nearest to 1024x768
def test_two_cameras_stream_on_while_the_consumer_sleeps_and_computes(size_px: tuple[int, int]) -> None:
    rate_hz = RATE_HZ if size_px == (640, 480) else RATE_HZ / 2  # the highest that vivid has there
    cameras = [
        open_camera(options(index, size_px=list(size_px), rate_hz=rate_hz), name=f"eye{index}")
        for index in range(2)
    ]
    try:
        for camera in cameras:
            camera.next_frame(time.monotonic(), 5.0)
        before = [camera.counters for camera in cameras]
        first = [camera.next_frame(time.monotonic(), 5.0) for camera in cameras]
        time.sleep(1.5)
        for _ in range(100):
            np.linalg.svd(np.random.default_rng(1).standard_normal((60, 60)))
            time.sleep(0.015)
        last = [camera.next_frame(time.monotonic(), 5.0) for camera in cameras]
        for camera, counted, begun, ended in zip(cameras, before, first, last, strict=True):
            counters = camera.counters
            frames = ended.driver_sequence - begun.driver_sequence
            assert frames / (ended.stamp_s - begun.stamp_s) == pytest.approx(rate_hz, rel=0.05)
            assert counters.good - counted.good > 0.5 * frames
            assert counters.damaged == counted.damaged and counters.reopened == 0
            if TURNED_CLOCK:
                assert counters.dropped == counted.dropped and counters.good - counted.good >= frames
            elif counters.dropped > counted.dropped:
                assert counters.late - counted.late < FRAMES_OF_A_FULL_RING
    finally:
        for camera in cameras:
            camera.close()


def test_a_reader_that_stood_still_counts_what_it_lost_and_what_came_late(camera: V4l2Camera) -> None:
    camera.next_frame(time.monotonic(), 5.0)
    before = camera.counters
    pause = f"kill -STOP {os.getpid()}; sleep 2; kill -CONT {os.getpid()}"
    subprocess.run(["sh", "-c", pause], check=True)
    camera.next_frame(time.monotonic(), 5.0)
    counters = camera.counters
    assert counters.late - before.late >= FRAMES_OF_A_FULL_RING
    lost = 2.0 / PERIOD_S - BUFFERS
    assert counters.dropped - before.dropped == pytest.approx(lost, abs=3 if TURNED_CLOCK else lost)
    assert counters.dropped > before.dropped and counters.reopened == 0
