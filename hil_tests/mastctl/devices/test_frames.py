"""Which frames are kept, for whom, and how many bytes of them in all."""

from __future__ import annotations

import contextlib
import gc
import weakref
from dataclasses import replace

import numpy as np
import pytest

from hil_tests.mastctl.recorder.recorder_world import frame
from mastctl.devices import frames as frames_module
from mastctl.devices.frames import KEPT_FRAMES, OPERATIONS, FrameStore
from mastctl.errors import MastctlError

DIGEST = "ab"
FRAME = np.zeros((1000, 1000), np.uint8)
"""Of 1 MB."""


def kept(store: FrameStore, numbers: range) -> list[int]:
    """Which of some frames are still found."""
    found = []
    for number in numbers:
        with contextlib.suppress(MastctlError):
            found.append(store.by_id(frame(number, FRAME).frame_id).sequence)
    return found


def test_frames_of_those_who_watch_have_a_total_and_the_oldest_give_way(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(frames_module, "WATCHED_BYTES", 10_000_000)
    store = FrameStore(DIGEST)
    for number in range(3):
        store.keep(frame(number, FRAME), OPERATIONS, 3)  # of results: they stay
    for number in range(3, 100):
        for watcher in range(3):  # each frame counts once, for however many it is kept
            store.keep(frame(number, FRAME), f"watcher {number} {watcher}", 4)
    assert kept(store, range(100)) == [0, 1, 2, *range(90, 100)]
    for number in range(95, 100):
        for watcher in range(3):
            store.release(f"watcher {number} {watcher}")
    for number in range(100, 105):
        store.keep(frame(number, FRAME), "watcher again", 32)
    assert kept(store, range(110)) == [0, 1, 2, *range(90, 95), *range(100, 105)], "what was let go is free"


def test_of_however_many_frames_a_camera_has_a_fixed_number_stays() -> None:
    store, alive = FrameStore(DIGEST), weakref.WeakSet[object]()
    for number in range(2000):
        one = replace(frame(number, FRAME), mast_digest=DIGEST)
        alive.add(one)
        store.add(one)
        if number % 3 == 0:
            store.publish(one)
        if number % 40 == 0:
            store.keep(one, OPERATIONS, 8)
        del one
    gc.collect()
    assert KEPT_FRAMES < len(alive) <= 2 * KEPT_FRAMES + 8, (
        "the newest, those that were requested, and those of results"
    )
