"""Exposure and gain of a GigE Vision camera changed as it streams: each frame is told what it truly has."""

from __future__ import annotations

import time
from collections.abc import Iterator

import pytest

from calib.geometry.mode import SensorMode
from drivers.aravis import library
from drivers.aravis.camera import AravisCamera
from drivers.errors import BadSetting
from drivers.newest import TimedFrame
from drivers.values_set import SETTLE_FRAMES
from hil_tests.drivers.aravis import gige_camera
from hil_tests.drivers.aravis.gige_camera import GigeCamera
from hil_tests.drivers.aravis.test_aravis_camera import ADDRESS, BUSY_S, OPENED, opened, truly_inside
from hil_tests.waiting import NET_S, until

pytestmark = pytest.mark.skipif(
    not library.installed(), reason=f"libaravis-0.8 is not installed: {library.INSTALL}"
)


@pytest.fixture
def device() -> Iterator[GigeCamera]:
    camera = GigeCamera(ADDRESS, clock_ahead_s=77.0, more=True)
    yield camera
    while OPENED:
        OPENED.pop().close()
    camera.unplug()


def taken(camera: AravisCamera, device: GigeCamera) -> TimedFrame:
    """The next frame, whose window holds its true exposure and whose settings are true or not told."""
    frame = camera.next_frame(time.monotonic(), NET_S)
    assert truly_inside(frame, device)
    began_s, ended_s = device.exposed_s[frame.driver_sequence - 1]
    truly = {"exposure_s": ended_s - began_s, "gain": device.gains[frame.driver_sequence - 1]}
    for name, value in truly.items():
        told = frame.settings[name]
        assert told is None or told == pytest.approx(value), f"{name} of frame {frame.sequence}"
    return frame


def settled(camera: AravisCamera, device: GigeCamera) -> TimedFrame:
    """The first frame whose exposure time is known again."""
    frame = taken(camera, device)
    while frame.settings["exposure_s"] is None:
        frame = taken(camera, device)
    return frame


def test_the_sensors_mode_follows_region_binning_and_flips(device: GigeCamera) -> None:
    """Offset and size count binned pixels, as GenICam's SFNC has it."""
    features = {"BinningHorizontal": 2, "BinningVertical": 3, "ReverseX": True}
    camera = opened(offset_px=[16, 4], features=features)
    assert camera.info.sensor_mode == SensorMode((64, 48), (32, 12, 128, 144), (256, 192), (True, False))


@pytest.mark.parametrize("behind", [0, 2])
def test_frames_have_the_former_value_then_none_then_the_new_one(device: GigeCamera, behind: int) -> None:
    device.behind = behind
    camera = opened(features={"ChunkModeActive": False}, gain=3.0)
    assert taken(camera, device).settings["exposure_s"] == pytest.approx(0.005)
    assert camera.adjust({"exposure_s": 0.012}) == []
    first = taken(camera, device)
    assert first.settings["exposure_s"] is None
    assert first.settings["gain"] == 3.0, "of the others nothing became unknown"
    with camera.exposure_held():  # waits until the change shows
        later = taken(camera, device)
    assert later.settings["exposure_s"] == pytest.approx(0.012)
    assert later.sequence >= first.sequence + SETTLE_FRAMES - 1


def test_a_longer_exposure_lies_in_its_window_without_a_clock() -> None:
    device = GigeCamera(ADDRESS, clock_readable=False, clock_ahead_s=-7.0, more=True)
    device.behind = 2
    camera = opened(features={"ChunkModeActive": False}, gain=3.0, margin_s=BUSY_S)
    try:
        for exposure_s in (0.018, 0.001):
            camera.adjust({"exposure_s": exposure_s})
            frame = settled(camera, device)
            assert frame.settings["exposure_s"] == pytest.approx(exposure_s)
        assert camera.counters.damaged == 0
    finally:
        camera.close()
        device.unplug()


def test_with_chunk_data_every_frame_is_told_its_own(device: GigeCamera) -> None:
    device.behind = 2
    camera = opened(gain=3.0)
    taken(camera, device)
    camera.adjust({"exposure_s": 0.012, "gain": 9.0})
    told = [taken(camera, device).settings for _ in range(SETTLE_FRAMES)]
    assert not any(None in one.values() for one in told)
    assert told[-1] == {"exposure_s": pytest.approx(0.012), "gain": 9.0}


def test_bounds_are_the_cameras_and_a_change_turns_the_automatic_off(device: GigeCamera) -> None:
    camera = opened()
    settings = {one.name: one for one in camera.settings()}
    exposure, gain = settings["exposure_s"], settings["gain"]
    assert (exposure.minimum, exposure.maximum) == pytest.approx((1e-7, 0.02))  # a frame's period
    assert (gain.minimum, gain.maximum, gain.automatic, gain.value) == (0.1, 24.0, True, None)
    camera.adjust({"gain": 4.0})
    values = {one.name: (one.value, one.automatic) for one in camera.settings()}
    assert values["gain"] == (4.0, False)


def test_a_rounded_value_is_told_and_a_refused_one_too(device: GigeCamera) -> None:
    camera = opened()
    (note,) = camera.adjust({"exposure_s": 0.004315})
    assert note == "cam: exposure_s is 0.00432 where 0.004315 was requested: the camera's nearest"
    device.refuses.add(gige_camera.EXPOSURE)
    with pytest.raises(BadSetting, match="cam: exposure_s was not changed: "):
        camera.adjust({"exposure_s": 0.008, "gain": 5.0})
    frame = settled(camera, device)
    assert frame.settings["exposure_s"] == pytest.approx(0.00432)


class RefusesAfter(set[int]):
    """Registers that are refused; the gain's automatic too once the gain was."""

    def __contains__(self, at: object) -> bool:
        if at == gige_camera.GAIN:
            self.add(gige_camera.GAIN_AUTO)
        return super().__contains__(at)


def test_a_refused_value_leaves_the_automatic_on_or_says_so(device: GigeCamera) -> None:
    camera = opened()
    device.refuses.add(gige_camera.GAIN)
    with pytest.raises(BadSetting, match=r"cam: gain was not changed: (?!.*GainAuto)"):
        camera.adjust({"gain": 5.0})
    gain = next(one for one in camera.settings() if one.name == "gain")
    assert (gain.automatic, gain.value) == (True, None)
    device.refuses = RefusesAfter({gige_camera.GAIN})
    with pytest.raises(BadSetting, match=r"cam: gain was not changed: .*; GainAuto stays Off: "):
        camera.adjust({"gain": 5.0})


def test_a_camera_that_is_opened_again_has_the_values_of_the_run_time(device: GigeCamera) -> None:
    camera = opened()
    camera.adjust({"exposure_s": 0.009, "gain": 7.0})
    device.unplug()
    until(lambda: camera.lost, "the loss")
    again = GigeCamera(ADDRESS, more=True)
    try:
        until(lambda: not camera.lost, "the return")
        frame = taken(camera, again)
    finally:
        again.unplug()
    assert frame.settings == {"exposure_s": pytest.approx(0.009), "gain": 7.0}
