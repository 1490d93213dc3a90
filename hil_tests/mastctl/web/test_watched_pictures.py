"""Watching cameras: whoever has left holds no frame and has no camera asked."""

from __future__ import annotations

import threading
from collections import Counter

import numpy as np
import pytest

from drivers.clock import SystemClock
from hil_tests.mastctl.recorder.recorder_world import frame
from hil_tests.waiting import until
from mastctl.devices.frames import StampedFrame
from mastctl.web import pictures
from mastctl.web.pictures import Picture, WatchedCameras, Watcher

LEFT, RIGHT = "navcam_left", "navcam_right"


class FakeCameras:
    """Gives pictures, and counts who holds any; ``as_held`` is called before each hold."""

    def __init__(self) -> None:
        self.held: Counter[str] = Counter()
        self.glances: Counter[str] = Counter()
        self.after_s: list[float] = []
        self.given: list[StampedFrame] = []
        self.as_held = lambda: None

    def glance(self, camera: str, exposed_after_s: float, max_age_s: float, timeout_s: float) -> StampedFrame:
        self.glances[camera] += 1
        self.after_s.append(exposed_after_s)
        self.given.append(frame(self.glances[camera], np.zeros((4, 4), np.uint8), b"jpeg", camera))
        return self.given[-1]

    def hold(self, frame: StampedFrame, by: str, kept: int) -> None:
        self.as_held()
        self.held[by] += 1

    def let_go(self, by: str) -> None:
        self.held.pop(by, None)


def pictures_threads() -> set[threading.Thread]:
    return {one for one in threading.enumerate() if one.name.startswith("pictures of")}


@pytest.fixture
def others() -> set[threading.Thread]:
    """Those of daemons that other tests of this process still hold."""
    return pictures_threads()


def test_a_watcher_who_leaves_as_a_picture_comes_holds_none(others: set[threading.Thread]) -> None:
    cameras, leaving, left = FakeCameras(), threading.Event(), threading.Event()

    def as_held() -> None:
        leaving.set()
        assert left.wait(60.0)

    cameras.as_held = as_held
    watched = WatchedCameras(cameras, SystemClock())
    woken: list[str] = []
    watcher = watched.watch((LEFT,), lambda: woken.append(LEFT))
    assert leaving.wait(60.0)
    watcher.end()
    left.set()
    until(lambda: not pictures_threads() - others, "the camera is asked no more")
    assert cameras.held == Counter() and watcher.take() == [] and woken == []
    watched.close()


def test_no_image_is_sent_while_one_is_on_its_way() -> None:
    watched = WatchedCameras(FakeCameras(), SystemClock())
    watcher = Watcher(watched, "slow", (LEFT,), lambda: None, ready=True)
    first, second, third = (Picture(frame(k, np.zeros((4, 4), np.uint8), b"", LEFT), b"") for k in range(3))
    watcher.put(first)  # not taken yet: its camera is asked for a newer one
    assert watcher.ready(LEFT) and watcher.take() == [first]
    watcher.put(second)
    assert watcher.take() == [], "one is on its way until it is shown"
    watcher.shown(LEFT)
    watcher.put(third)
    assert watcher.take() == [third]


@pytest.mark.parametrize(("every", "apart_s"), [(False, pictures.APART_S), (True, pictures.NEXT_S)])
def test_a_viewer_of_every_image_gets_the_next_one(every: bool, apart_s: float) -> None:
    cameras, there = FakeCameras(), threading.Event()
    watched = WatchedCameras(cameras, SystemClock())
    watcher = watched.watch((LEFT,), there.set, every=every)
    assert there.wait(60.0)
    watcher.take()
    watcher.shown(LEFT)
    until(lambda: len(cameras.after_s) > 1, "the next one is asked for")
    assert cameras.after_s[1] == pytest.approx(cameras.given[0].exposure_began_s + apart_s)
    small, large = (frame(1, np.zeros(size, np.uint8), b"", LEFT) for size in ((4, 4), (6000, 4000)))
    assert watcher.held_of(small) == (32 if every else 4)
    assert watcher.held_of(large) == 4  # 24 MB each
    watcher.end()
    watched.close()
