"""Settings at run time on the kernel's vivid: a running stream gets a gain, and a reopened one has it."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Iterator

import pytest

from drivers.v4l2 import find
from drivers.v4l2.camera import V4l2Camera, open_camera
from drivers.values_set import SETTLE_FRAMES
from hil_tests.vm.inside.conftest import BUS, options
from hil_tests.waiting import NET_S


@pytest.fixture
def camera() -> Iterator[V4l2Camera]:
    made = open_camera(options(gain=10), name="left")
    yield made
    made.close()


def by_v4l2_ctl(control: str) -> int:
    """A control's value as v4l2-ctl reads it."""
    node = next(one.node for one in find.list_cameras() if one.bus == BUS[0])
    told = subprocess.run(
        ["v4l2-ctl", "-d", str(node), "-C", control],
        capture_output=True,
        text=True,
        timeout=NET_S,
        check=True,
    )
    return int(told.stdout.split(":")[1])


def settled(camera: V4l2Camera) -> float | None:
    """The gain of the first frame of which it is known."""
    for _ in range(3 * SETTLE_FRAMES):
        frame = camera.next_frame(time.monotonic(), NET_S)
        if frame.settings["gain"] is not None:
            return frame.settings["gain"]
    return None


def test_a_gain_is_changed_while_frames_come_and_each_frame_has_its_own(camera: V4l2Camera) -> None:
    assert settled(camera) == 10.0
    gain = next(one for one in camera.settings() if one.name == "gain")
    assert (gain.value, gain.minimum, gain.maximum, gain.automatic) == (10.0, 0.0, 255.0, False)
    began_s = time.monotonic()
    assert camera.adjust({"gain": 77.0}) == []
    ended_s = time.monotonic()
    assert by_v4l2_ctl("gain") == 77 and by_v4l2_ctl("gain_automatic") == 0
    unknown = 0
    for _ in range(3 * SETTLE_FRAMES):
        frame = camera.next_frame(began_s, NET_S)
        began_s = frame.mid_exposure_s
        told = frame.settings["gain"]
        assert told in (None, 77.0) or (told == 10.0 and frame.stamp_s < ended_s)
        unknown += told is None
    assert told == 77.0 and unknown <= SETTLE_FRAMES + 1
    with camera.exposure_held():
        assert camera.next_frame(time.monotonic(), NET_S).settings["gain"] == 77.0
