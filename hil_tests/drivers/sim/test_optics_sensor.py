"""Exposure, gain, automatic exposure, colour and JPEG of simulated cameras, without a renderer."""

from __future__ import annotations

import numpy as np
import pytest

from drivers.clock import ManualClock
from drivers.errors import BadFrame
from drivers.faults import FaultPanel
from drivers.sim.cameras import SimulatedCamera
from drivers.sim.settings import CameraSettings, ExposureSettings
from mastctl.devices.frames import checked

SIZE = (64, 48)
START = 1000.0


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
    made = SimulatedCamera(
        "cam_left", settings, SIZE, lambda b, e: scene.light(b), lambda n, t: None, clock, panel, START,
        metered=scene.light,
    )  # fmt: skip
    return made, clock


def mean_dn(device: SimulatedCamera, clock: ManualClock) -> float:
    return float(device.next_frame(clock.now_s(), 1.0).image.mean())


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


def automatic(scene: Scene, **changes: object) -> tuple[SimulatedCamera, ManualClock]:
    exposure = ExposureSettings(**{"reference_s": 0.008, "auto": True, **changes})  # type: ignore[arg-type]
    return camera(scene, exposure=exposure)


@pytest.mark.parametrize(("level", "gained"), [(200.0, False), (8.0, True)])
def test_the_loop_reaches_its_target_by_time_first_and_gain_after(level: float, gained: bool) -> None:
    device, clock = automatic(Scene(level))
    first = mean_dn(device, clock)
    clock.advance(4.0)
    frame = device.next_frame(clock.now_s(), 1.0)
    assert first == pytest.approx(level, abs=6)
    assert frame.image.mean() == pytest.approx(110.0, abs=4.0)
    assert (frame.exposure_s == pytest.approx(0.03)) == gained


def test_colour_pictures_are_mosaics_made_whole_again() -> None:
    quiet = {"read_noise_dn": 0.0, "shot_noise_dn": 0.0}
    device, clock = camera(Scene(100.0), colour=True, **quiet)
    image = device.next_frame(clock.now_s(), 1.0).image
    assert image.shape == (48, 64, 3) and image.dtype == np.uint8
    inner = image[4:-4, 4:-4].reshape(-1, 3).mean(axis=0)
    assert inner == pytest.approx([70.0, 86.0, 100.0], abs=1.0), "blue, green, red of the scene's own tint"


def test_a_changed_setting_shows_in_frames_that_begin_after_it() -> None:
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
