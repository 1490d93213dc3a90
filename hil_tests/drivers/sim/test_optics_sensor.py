"""Exposure, gain, automatic exposure, colour and JPEG of simulated cameras, without a renderer."""

from __future__ import annotations

from contextlib import nullcontext

import cv2
import numpy as np
import pytest

from drivers.clock import ManualClock
from drivers.errors import BadFrame, BadSetting
from drivers.faults import FaultPanel
from drivers.interfaces import HoldsExposure
from drivers.sim.camera_settings import CameraSettings
from drivers.sim.cameras import SelfExposedCamera, SimulatedCamera
from drivers.sim.optics.exposure import ExposureSettings
from mastctl.devices.frames import checked

SIZE = (64, 48)
START = 1000.0
PERIOD_S = 0.1


class Scene:
    """A grey ramp whose brightness may change at a moment."""

    def __init__(self, level: float = 80.0) -> None:
        self.level = level
        self.brighter_s = (np.inf, np.inf)
        self.factor = 1.0

    def light(self, time_s: float) -> np.ndarray:
        level = self.level * (self.factor if self.brighter_s[0] <= time_s < self.brighter_s[1] else 1.0)
        return (level * (0.5 + np.mgrid[0 : SIZE[1], 0 : SIZE[0]][1] / (SIZE[0] - 1))).astype(np.float32)


def camera(scene: Scene, **changes: object) -> tuple[SimulatedCamera, ManualClock]:
    clock = ManualClock(START)
    settings = CameraSettings(**{"seed": 3, **changes})  # type: ignore[arg-type]
    panel = FaultPanel(clock.now_s, ["cam_left"])
    usual = (
        "cam_left", settings, SIZE, lambda b, e: scene.light(b), lambda n, t: None, clock, panel, START,
    )  # fmt: skip
    if settings.exposure.auto:
        return SelfExposedCamera(scene.light, *usual), clock
    return SimulatedCamera(*usual), clock


def mean_dn(device: SimulatedCamera, clock: ManualClock) -> float:
    return float(device.next_frame(clock.now_s(), 1.0).image.mean())


def test_grey_levels_grow_with_exposure_time_and_gain_where_a_reference_is_set() -> None:
    for exposure_s, gain, reference_s, expected in (
        (0.008, 1.0, 0.008, 80.0),
        (0.004, 1.0, 0.008, 40.0),
        (0.004, 3.0, 0.008, 120.0),
        (0.02, 1.0, 0.0, 80.0),
    ):
        exposure = ExposureSettings(reference_s=reference_s, gain=gain)
        device, clock = camera(Scene(), exposure_s=exposure_s, exposure=exposure)
        assert mean_dn(device, clock) == pytest.approx(expected, abs=0.5)


def test_gain_brings_its_noise_and_too_much_light_saturates() -> None:
    spreads = []
    for exposure_s, gain in ((0.008, 1.0), (0.001, 8.0)):
        exposure = ExposureSettings(reference_s=0.008, gain=gain)
        device, clock = camera(Scene(), exposure_s=exposure_s, exposure=exposure)
        image = device.next_frame(clock.now_s(), 1.0).image.astype(float)
        spreads.append((image - Scene().light(0)).std())
    # an eighth of the light and eight times the gain: shot noise by the root of eight, read noise by eight
    variance = 1.0 + 1.7**2 / 128 * 80, 64.0 + 8 * 1.7**2 / 128 * 80
    assert spreads == pytest.approx(np.sqrt(variance), rel=0.06)
    device, clock = camera(Scene(), exposure_s=0.07, exposure=ExposureSettings(reference_s=0.008))
    frame = device.next_frame(clock.now_s(), 1.0)
    assert (frame.image == 255).mean() > 0.9
    with pytest.raises(BadFrame, match="the picture is saturated: its darkest hundredth is at 2"):
        checked(frame, "cam_left", SIZE, 0.0, clock.now_s())


def automatic(scene: Scene, **changes: object) -> tuple[SelfExposedCamera, ManualClock]:
    exposure = ExposureSettings(**{"reference_s": 0.008, "auto": True, **changes})  # type: ignore[arg-type]
    device, clock = camera(scene, exposure=exposure)
    assert isinstance(device, SelfExposedCamera) and isinstance(device, HoldsExposure)
    return device, clock


@pytest.mark.parametrize(("level", "gained"), [(200.0, False), (8.0, True)])
def test_the_loop_reaches_its_target_by_time_first_and_gain_after(level: float, gained: bool) -> None:
    device, clock = automatic(Scene(level))
    first = mean_dn(device, clock)
    clock.advance(4.0)
    frame = device.next_frame(clock.now_s(), 1.0)
    assert first == pytest.approx(level, abs=6)
    assert frame.image.mean() == pytest.approx(110.0, abs=4.0)
    assert (frame.exposure_s == pytest.approx(0.03)) == gained


def test_what_is_decided_shows_frames_later_and_the_same_whether_anybody_looks() -> None:
    exposures_s = []
    for first_s in (1.95, 2.65):
        scene = Scene(110.0)
        scene.brighter_s, scene.factor = (START + 1.99, np.inf), 2.0
        device, _ = automatic(scene, lag_frames=3)
        after_s, taken = START + first_s, []
        while not taken or taken[-1].sequence < 27:
            taken.append(device.next_frame(after_s, 4.0))
            after_s = taken[-1].exposure_began_s
        exposures_s.append([frame.exposure_s for frame in taken])
    looked_s, unseen_s = exposures_s
    assert looked_s[:3] == [0.008] * 3, "the change is metered with frame 20, but not yet in force"
    assert looked_s[3] < 0.8 * 0.008
    assert len(unseen_s) == 1 and unseen_s[0] == looked_s[-1]


def test_a_program_that_compares_pictures_is_fooled_unless_it_holds_the_exposure() -> None:
    """A bright thing came by between two pictures: what stood still seems to have changed."""
    differences_dn = {}
    for holds in (False, True):
        scene = Scene(60.0)
        scene.brighter_s, scene.factor = (START + 5.0, START + 6.3), 3.0
        device, clock = automatic(scene)
        clock.advance(4.5)
        with device.exposure_held() if holds else nullcontext():
            before = device.next_frame(clock.now_s(), 1.0)
            after = device.next_frame(START + 6.35, 3.0)
        differences_dn[holds] = abs(float(after.image.mean()) - float(before.image.mean()))
        assert (before.exposure_s == after.exposure_s) == holds
    assert differences_dn[True] < 1.0 < 20.0 < differences_dn[False]


def test_the_frame_after_a_frame_is_the_next_one_however_its_times_are_rounded() -> None:
    device, _ = camera(
        Scene(30.0), row_time_s=1.89e-5, exposure=ExposureSettings(reference_s=0.008, auto=True)
    )
    after_s = START
    for number in range(1, 200):
        frame = device.next_frame(after_s, 4.0)
        assert frame.sequence == number and frame.exposure_began_s > after_s
        after_s = frame.exposure_began_s


def test_after_a_hold_the_loop_goes_on() -> None:
    scene = Scene(20.0)
    device, clock = automatic(scene)
    with device.exposure_held():
        clock.advance(3.0)
        held = mean_dn(device, clock)
    clock.advance(3.0)
    assert held == pytest.approx(20.0, abs=1.0)
    assert mean_dn(device, clock) == pytest.approx(110.0, abs=5.0)


def test_evening_is_darker_than_noon() -> None:
    exposure = ExposureSettings(reference_s=0.008, day_s=100.0, night_share=0.2)
    device, clock = camera(Scene(100.0), exposure=exposure)
    noon = mean_dn(device, clock)
    clock.advance(49.8)
    assert mean_dn(device, clock) == pytest.approx(0.2 * noon, abs=1.0)


def test_colour_pictures_are_mosaics_made_whole_again() -> None:
    quiet = {"read_noise_dn": 0.0, "shot_noise_dn": 0.0}
    device, clock = camera(Scene(100.0), colour=True, **quiet)
    image = device.next_frame(clock.now_s(), 1.0).image
    assert image.shape == (48, 64, 3) and image.dtype == np.uint8
    inner = image[4:-4, 4:-4].reshape(-1, 3).mean(axis=0)
    assert inner == pytest.approx([70.0, 86.0, 100.0], abs=1.0), "blue, green, red of the scene's own tint"


def test_a_mosaic_blurs_and_its_noise_is_not_each_pixels_own() -> None:
    device, clock = camera(Scene(100.0), colour=True)
    image = device.next_frame(clock.now_s(), 1.0).image
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY).astype(float)
    noise = grey - grey.mean(axis=0)
    alike = np.corrcoef(noise[:, 1:].ravel(), noise[:, :-1].ravel())[0, 1]
    assert alike > 0.25
    plain, clock = camera(Scene(100.0))
    grey = plain.next_frame(clock.now_s(), 1.0).image.astype(float)
    noise = grey - grey.mean(axis=0)
    assert abs(np.corrcoef(noise[:, 1:].ravel(), noise[:, :-1].ravel())[0, 1]) < 0.1


@pytest.mark.parametrize("colour", [False, True])
def test_jpeg_leaves_its_blocks(colour: bool) -> None:
    device, clock = camera(Scene(100.0), colour=colour, jpeg_quality=60)
    plain, _ = camera(Scene(100.0), colour=colour)
    image = device.next_frame(clock.now_s(), 1.0).image
    raw = plain.next_frame(START, 1.0).image
    assert image.shape == raw.shape and (image != raw).any()
    _, data = cv2.imencode(".jpg", raw, [cv2.IMWRITE_JPEG_QUALITY, 60])
    np.testing.assert_array_equal(image, cv2.imdecode(data, cv2.IMREAD_UNCHANGED))


def test_faults_reach_pictures_of_three_channels() -> None:
    for word, more in (("dark", {}), ("garbage", {}), ("frozen", {}), ("wrong", {"dx_px": 3, "dy_px": 0})):
        device, clock = camera(Scene(100.0), colour=True, jpeg_quality=90)
        device.next_frame(clock.now_s(), 1.0)
        device._faults.set("cam_left", word, **more)
        clock.advance(1.0)
        assert device.next_frame(clock.now_s(), 1.0).image.shape == (48, 64, 3), word


def test_everything_off_is_the_picture_of_before() -> None:
    """Levels of a fixed seed as they were drawn before there was any of this."""
    device, clock = camera(Scene(100.0))
    image = device.next_frame(clock.now_s(), 1.0).image
    noise = device._readout.noise
    light = Scene(100.0).light(0)
    np.testing.assert_array_equal(image, noise.levels(light, noise.sigma_dn(light), 1))


def test_a_changed_exposure_and_gain_change_brightness_and_noise_of_frames_that_begin_after_it() -> None:
    device, clock = camera(Scene(40.0))
    first = device.next_frame(clock.now_s(), 1.0)
    assert first.settings == {"exposure_s": 0.008, "gain": 1.0}
    changed_s = clock.now_s()
    assert device.adjust({"exposure_s": 0.016, "gain": 2.0}) == []
    before = device.next_frame(first.exposure_began_s - 1e-6, 1.0)
    after = device.next_frame(changed_s, 1.0)
    assert before.sequence == first.sequence and before.settings == first.settings
    assert after.exposure_began_s > changed_s
    assert after.settings == {"exposure_s": 0.016, "gain": 2.0} and after.exposure_s == 0.016
    assert after.image.mean() == pytest.approx(4 * first.image.mean(), rel=0.02)
    device.adjust({"exposure_s": 0.008})
    gained = device.next_frame(clock.now_s(), 1.0)
    device.adjust({"exposure_s": 0.016, "gain": 1.0})
    exposed = device.next_frame(clock.now_s(), 1.0)
    assert gained.image.mean() == pytest.approx(exposed.image.mean(), abs=0.5)
    noise = [(one.image - one.image.mean(axis=0)).std() for one in (gained, exposed)]
    assert noise[0] > 1.3 * noise[1], "the same brightness by gain is noisier"


def test_what_a_simulated_camera_cannot_change_it_says() -> None:
    device, _ = camera(Scene(40.0))
    assert {one.name: one.refusal for one in device.settings()} == {"exposure_s": "", "gain": ""}
    with pytest.raises(BadSetting, match="the simulated camera has no focus"):
        device.adjust({"focus": 3.0})
    itself, _ = automatic(Scene(40.0))
    assert all(one.automatic and "exposure.auto" in one.refusal for one in itself.settings())
    with pytest.raises(BadSetting, match="it sets its exposure itself"):
        itself.adjust({"gain": 2.0})
