"""Feeds of live pictures: a viewer that has left keeps no frame and has no camera take any."""

from __future__ import annotations

import asyncio
import threading
from collections import Counter
from typing import Any

import numpy as np
import pytest

from drivers.clock import SystemClock
from hil_tests.mastctl.recorder.recorder_world import frame
from hil_tests.waiting import NET_S
from mastctl.devices.frames import StampedFrame
from mastctl.web import pictures
from mastctl.web.pictures import CameraFeeds, Picture, Viewer

LEFT = "navcam_left"


@pytest.fixture
def anyio_backend() -> str:
    return "asyncio"


class FakeCameras:
    """Gives pictures, and counts those that are kept for each viewer; ``as_kept`` is called before each."""

    def __init__(self) -> None:
        self.store: Any = self
        self.kept: Counter[str] = Counter()
        self.glances: Counter[str] = Counter()
        self.after_s: list[float] = []
        self.given: list[StampedFrame] = []
        self.released = 0
        self.as_kept = lambda: None

    def watched_frame(
        self, camera: str, exposed_after_s: float, max_age_s: float, timeout_s: float
    ) -> StampedFrame:
        self.glances[camera] += 1
        self.after_s.append(exposed_after_s)
        self.given.append(frame(self.glances[camera], np.zeros((4, 4), np.uint8), b"jpeg", camera))
        return self.given[-1]

    def keep(self, frame: StampedFrame, keeper: str, most: int) -> None:
        self.as_kept()
        self.kept[keeper] += 1

    def release(self, keeper: str) -> None:
        self.released += 1
        self.kept.pop(keeper, None)


async def shown(viewer: Viewer) -> list[Picture]:
    """The next pictures of a viewer."""
    async with asyncio.timeout(NET_S):
        await viewer.news.wait()
    return viewer.take()


@pytest.mark.anyio
async def test_a_viewer_who_leaves_as_a_picture_comes_keeps_none() -> None:
    cameras: Any = FakeCameras()
    leaving, left = threading.Event(), threading.Event()

    def as_kept() -> None:
        leaving.set()
        assert left.wait(NET_S)

    cameras.as_kept = as_kept
    feeds = CameraFeeds(cameras, SystemClock())
    with feeds.viewer([LEFT]) as viewer:
        assert await asyncio.to_thread(leaving.wait, NET_S)
    left.set()
    async with asyncio.timeout(NET_S):
        while cameras.released < 2:  # as it left, and when its picture was kept after all
            await asyncio.sleep(0.001)
    assert cameras.kept == Counter() and viewer.take() == []


@pytest.mark.anyio
async def test_no_picture_is_taken_while_no_viewer_is_ready() -> None:
    cameras: Any = FakeCameras()
    feeds = CameraFeeds(cameras, SystemClock())
    with feeds.viewer([LEFT], ready=False) as viewer:
        for _ in range(20):
            await asyncio.sleep(0)
        assert cameras.glances == Counter()
        viewer.want(LEFT)
        feeds.stir()
        assert len(await shown(viewer)) == 1
    feeds.close()


def test_no_picture_is_sent_while_one_is_on_its_way() -> None:
    viewer = Viewer("slow", [LEFT], ready=True, every=False)
    first, second, third = (Picture(frame(k, np.zeros((4, 4), np.uint8), b"", LEFT), b"") for k in range(3))
    viewer.put(first)  # not taken yet: its camera may bring a newer one
    assert viewer.ready(LEFT) and viewer.take() == [first]
    viewer.put(second)
    assert viewer.take() == [], "one is on its way until it is shown"
    viewer.want(LEFT)
    viewer.put(third)
    assert viewer.take() == [third]


@pytest.mark.anyio
@pytest.mark.parametrize(("every", "apart_s"), [(False, pictures.APART_S), (True, pictures.NEXT_S)])
async def test_a_viewer_of_every_picture_gets_the_next_one(every: bool, apart_s: float) -> None:
    cameras: Any = FakeCameras()
    feeds = CameraFeeds(cameras, SystemClock())
    with feeds.viewer([LEFT], every=every) as viewer:
        await shown(viewer)
        viewer.want(LEFT)
        feeds.stir()
        await shown(viewer)
    assert cameras.after_s[1] == pytest.approx(cameras.given[0].exposure_began_s + apart_s)
    small, large = (frame(1, np.zeros(size, np.uint8), b"", LEFT) for size in ((4, 4), (6000, 4000)))
    assert viewer.kept_of(small) == (32 if every else 4)
    assert viewer.kept_of(large) == 4  # 24 MB each
    feeds.close()
