"""The package of docs/drivers.md, installed from outside the repository, works as head and cameras."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from calib.files.mast_file import load_rig
from calib.geometry.pointing import solve
from drivers.clock import SystemClock
from drivers.errors import BadOptions, NoFreshFrame, NoReply
from drivers.hardware import DeviceSettings, Hardware, HardwareSettings, installed_drivers
from drivers.interfaces import Camera, Frame, PanTilt
from drivers.open_hardware import open_hardware
from hil_tests.waiting import NET_S
from mastctl.devices.devices import Devices
from mastctl.devices.limits import Limits
from mastctl.motion.loop import PointingLoop
from mastctl.motion.requests import AnglesTarget, PixelTarget, PointRequest
from mastctl.motion.results import PointingError, Step
from mastctl.setup.machine import examine_drivers

TOO_NEW_S = 1.5
"""0.3 s were seen on a rig; more, so that a busy machine does not make late pictures of them."""
LANDED_WITHIN_PX = 0.6
"""Peak of a plain correlation to the whole pixel, and a floor seen from another side."""


@pytest.fixture(scope="module")
def mast_file(repository: Path) -> Path:
    return repository / "configs" / "masts" / "rocky8_simulated.yaml"


@pytest.fixture
def hardware(installed: Path, mast_file: Path) -> Iterator[Hardware]:
    camera = "bench_rig"  # as the package names it
    cameras = {
        name: DeviceSettings(camera, {"mast_file": str(mast_file), "name": name})
        for name in ("navcam_left", "navcam_right")
    }
    head = DeviceSettings("bench_rig.head:open_head", {"speed_rad_per_s": 1.5})
    with open_hardware(HardwareSettings(head, cameras)) as hardware:
        yield hardware


@pytest.mark.parametrize("name", ["bench_rig/head.py", "bench_rig/camera.py"])
def test_each_driver_takes_under_sixty_lines(sources: dict[str, str], name: str) -> None:
    assert 20 < len(sources[name].splitlines()) < 60


def test_the_package_comes_from_outside_the_repository(
    hardware: Hardware, installed: Path, repository: Path
) -> None:
    module = sys.modules[type(hardware.pan_tilt).__module__]
    assert Path(str(module.__file__)).is_relative_to(installed)
    assert not installed.is_relative_to(repository)
    assert hardware.kind == "real" and isinstance(hardware.pan_tilt, PanTilt)


def wait_until_still(head: PanTilt) -> None:
    deadline_s = time.monotonic() + NET_S
    while head.read().moving:
        assert time.monotonic() < deadline_s, "the head never settled"
        time.sleep(0.01)


def test_a_spot_of_the_floor_is_pointed_at(hardware: Hardware, mast_file: Path) -> None:
    """Where a spot of the first picture lands is measured by correlation, not by the geometry that aimed."""
    rig = load_rig(mast_file).rig
    head, eye = hardware.pan_tilt, hardware.cameras["navcam_left"]
    head.move(0.2, -0.5)
    wait_until_still(head)
    before = eye.next_frame(time.monotonic(), 5.0).image
    reading = head.read()
    spot_px = np.array([560, 420])
    rays = rig.camera_in_rover("navcam_left", reading.pan_rad, reading.tilt_rad).ray(spot_px)
    spot_in_rover_m = rays.origins_m - rays.origins_m[2] / rays.directions[2] * rays.directions
    camera = rig.cameras["navcam_left"].model
    aim = solve(rig.mast, camera, spot_in_rover_m)[0]
    head.move(aim.pan_rad, aim.tilt_rad)
    wait_until_still(head)
    after = eye.next_frame(time.monotonic(), 5.0).image
    x, y = spot_px
    template = before[y - 15 : y + 16, x - 15 : x + 16]
    score = cv2.matchTemplate(after, template, cv2.TM_CCOEFF_NORMED)
    _, best, _, corner = cv2.minMaxLoc(score)
    assert best > 0.8
    landed_px = np.array(corner) + 15
    assert np.abs(landed_px - camera.image_center_px).max() < LANDED_WITHIN_PX + 0.5


def test_the_pointing_loop_runs_on_it(hardware: Hardware, mast_file: Path) -> None:
    """From a clicked pixel to a residual measured in a new image, twice over; the texture is the witness."""
    stored = load_rig(mast_file)
    limits = Limits((-2.0, 2.0), (-1.2, 0.5), 1.5)
    clock = SystemClock()
    devices = Devices(hardware, limits, stored.digest, clock, stored.rig)
    loop = PointingLoop(stored.rig, devices, limits, clock)
    steps: list[Step] = []
    try:
        loop.run(PointRequest(AnglesTarget(-0.3, -0.5)), steps.append, threading.Event())
        clicked = devices.frames(["navcam_left"], clock.now_s(), 5.0)["navcam_left"]
        spot_px = (600, 330)
        target = PixelTarget("navcam_left", clicked.frame_id, *spot_px)
        result = loop.run(PointRequest(target, pointings=2), steps.append, threading.Event())
        after = devices.frame_by_id(result.pointings[-1].frame_id)
    finally:
        devices.close()
    assert [step.name for step in steps].count("measure") == 2
    assert all(step.state == "done" for step in steps)
    for pointing in result.pointings:
        assert pointing.residual_px is not None
        # The rig is exact, the head has no counts and no play: nothing but the matching is left.
        assert np.abs(pointing.residual_px).max() < 0.2
    x, y = spot_px
    score = cv2.matchTemplate(
        after.image, clicked.image[y - 15 : y + 16, x - 15 : x + 16], cv2.TM_CCOEFF_NORMED
    )
    landed_px = np.array(cv2.minMaxLoc(score)[3]) + 15
    centre_px = stored.rig.cameras["navcam_left"].model.image_center_px
    assert np.abs(landed_px - centre_px).max() < LANDED_WITHIN_PX + 0.5


class Buffered:
    """A camera that delivers, with a new stamp, the picture that waited in its buffer."""

    def __init__(self, camera: Camera) -> None:
        self._camera = camera
        self._waiting: np.ndarray | None = None

    def next_frame(self, exposed_after_s: float, timeout_s: float) -> Frame:
        frame = self._camera.next_frame(exposed_after_s, timeout_s)
        shown = frame.image if self._waiting is None else self._waiting
        self._waiting = frame.image
        return replace(frame, image=noisy(shown, frame.sequence))

    def close(self) -> None:
        self._camera.close()


class StampedTooNew:
    """A camera that stamps a picture when it leaves its pipeline, not when it was exposed."""

    def __init__(self, camera: Camera) -> None:
        self._camera = camera

    def next_frame(self, exposed_after_s: float, timeout_s: float) -> Frame:
        frame = self._camera.next_frame(exposed_after_s, timeout_s)
        exposed = self._camera._picture(frame.mid_exposure_s - TOO_NEW_S)  # type: ignore[attr-defined]
        return replace(frame, image=noisy(exposed, frame.sequence))

    def close(self) -> None:
        self._camera.close()


def noisy(image: np.ndarray, seed: int) -> np.ndarray:
    """No two deliveries are equal to the last bit."""
    grain = np.random.default_rng(seed).normal(scale=1.5, size=image.shape)
    return np.clip(np.rint(image + grain), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("wrong", [Buffered, StampedTooNew])
def test_pictures_of_before_with_new_stamps_end_in_bad_frame(
    hardware: Hardware, mast_file: Path, wrong: type[Buffered] | type[StampedTooNew]
) -> None:
    """What the driver says is consistent in itself; only the pictures deny it."""
    stored = load_rig(mast_file)
    cameras = {name: wrong(camera) for name, camera in hardware.cameras.items()}
    limits, clock = Limits((-2.0, 2.0), (-1.2, 0.5), 1.5), SystemClock()
    wrapped = SimpleNamespace(pan_tilt=hardware.pan_tilt, cameras=cameras)
    devices = Devices(wrapped, limits, stored.digest, clock, stored.rig)
    loop = PointingLoop(stored.rig, devices, limits, clock)
    try:
        loop.run(PointRequest(AnglesTarget(-0.3, -0.5)), lambda step: None, threading.Event())
        time.sleep(TOO_NEW_S + 0.1)
        for _ in range(2):
            clicked = devices.frames(["navcam_left"], clock.now_s(), 5.0)["navcam_left"]
        with pytest.raises(PointingError) as refusal:
            target = PixelTarget("navcam_left", clicked.frame_id, 600, 330)
            loop.run(PointRequest(target), lambda step: None, threading.Event())
    finally:
        devices.close()
    assert refusal.value.code == "bad_frame", str(refusal.value)
    assert refusal.value.step == "look"
    assert "navcam_left: the picture shows the view of pan -0.2" in str(refusal.value) or (
        "navcam_left: the picture shows the view of pan -0.3" in str(refusal.value)
    )


def test_it_keeps_the_promises_of_the_page(hardware: Hardware) -> None:
    head, eye = hardware.pan_tilt, hardware.cameras["navcam_right"]
    asked_s = time.monotonic()
    frame = eye.next_frame(asked_s, 5.0)
    assert frame.mid_exposure_s - frame.exposure_s / 2 > asked_s
    with pytest.raises(NoFreshFrame):
        eye.next_frame(time.monotonic() + 10, 0.05)
    head.move(0.5, 0.0)
    assert head.read().moving
    head.stop()
    while (stopped := head.read()).moving:  # it brakes, the longer the later the stop came
        assert time.monotonic() < asked_s + NET_S
    assert stopped.pan_rad < 0.4
    head.close()
    with pytest.raises(NoReply):
        head.read()


def test_options_it_refuses_are_told_in_its_own_words(installed: Path) -> None:
    head = DeviceSettings("bench_rig.head:open_head", {"speed_rad_per_s": -1})
    with pytest.raises(BadOptions, match="bench head: speed_rad_per_s is -1, expected above 0"):
        open_hardware(HardwareSettings(head, {}))


def test_drivers_of_installed_packages_are_found_by_their_names(installed: Path) -> None:
    with open_hardware(HardwareSettings(DeviceSettings("bench_rig"), {})) as hardware:
        assert Path(str(sys.modules[type(hardware.pan_tilt).__module__].__file__)).is_relative_to(installed)
    with pytest.raises(BadOptions, match=r"no driver 'bench_rib'; did you mean 'bench_rig'"):
        open_hardware(HardwareSettings(DeviceSettings("bench_rib"), {}))


def test_a_name_that_packages_quarrel_about_is_refused_and_told_by_the_doctor(
    installed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    info = tmp_path / "other_rig-2.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: other-rig\nVersion: 2.0\n")
    (info / "entry_points.txt").write_text(
        "[mastctl.heads]\nbench_rig = other:head\ndynamixel = other:head\n"
        "[mastctl.cameras]\neye = other:eye\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(BadOptions, match=r"bench-rig 1\.0 and other-rig 2\.0 both offer"):
        open_hardware(HardwareSettings(DeviceSettings("bench_rig"), {}))
    with pytest.raises(BadOptions, match=r"driver 'eye' of other-rig 2\.0 is for a camera, not for a head"):
        open_hardware(HardwareSettings(DeviceSettings("eye"), {}))
    listed = [(one.what, one.level, one.sentence) for one in examine_drivers(installed_drivers())]
    assert ("driver eye", "good", "for a camera: other:eye of other-rig 2.0") in listed
    assert [level for what, level, words in listed if what == "driver bench_rig"] == ["unsure"] * 2 + ["good"]
    (own,) = (words for what, level, words in listed if what == "driver dynamixel" and level == "unsure")
    assert own.endswith("mastctl's own driver of this name is used instead")


def test_a_driver_that_is_installed_meanwhile_is_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(tmp_path))
    before = installed_drivers()
    assert installed_drivers() is before, "packages are read again only where something changed"
    info = tmp_path / "late_rig-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: late-rig\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[mastctl.heads]\nlate_rig = late:head\n")
    (late,) = set(installed_drivers()) - set(before)
    assert (late.kind, late.name, late.factory, late.package) == (
        "head", "late_rig", "late:head", "late-rig 1.0",
    )  # fmt: skip


def test_the_head_of_the_page_comes_to_rest_at_every_goal(installed: Path) -> None:
    """Also where sum and difference of the angles do not round back to the goal."""
    from bench_rig.head import BenchHead  # type: ignore[import-not-found]

    head, random = BenchHead(1e9), np.random.default_rng(4)
    for pan_rad, tilt_rad in random.uniform(-3.0, 3.0, (200, 2)) / 3.0:  # off the grid of 2^-52
        head.move(pan_rad, tilt_rad)
        time.sleep(1e-6)
        reading = head.read()
        assert (reading.pan_rad, reading.tilt_rad, reading.moving) == (pan_rad, tilt_rad, False)
