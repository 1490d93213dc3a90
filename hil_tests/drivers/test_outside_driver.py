"""The package of docs/drivers.md, installed from outside the repository, works as head and cameras."""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from calib.files.mast_file import load_rig
from drivers.clock import SystemClock
from drivers.errors import BadOptions
from drivers.hardware import DeviceSettings, Hardware, HardwareSettings, clock_for
from drivers.open_hardware import halt_head, open_hardware
from drivers.registry import installed_drivers
from mastctl.answers import PointingResult, Step
from mastctl.devices.devices import Devices
from mastctl.devices.judge import Limits
from mastctl.motion.loop import PointingLoop
from mastctl.motion.requests import PixelTarget, PointRequest
from mastctl.setup.doctor import examine_drivers

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
    head = DeviceSettings("bench_rig.head:DRIVER", {"speed_rad_per_s": 1.5})
    with open_hardware(HardwareSettings(head, cameras)) as hardware:
        yield hardware


def test_the_pointing_loop_runs_on_it(hardware: Hardware, mast_file: Path) -> None:
    """From a clicked pixel to a residual measured in a new image, twice over; the texture is the witness."""
    stored = load_rig(mast_file)
    limits = Limits((-2.0, 2.0), (-1.2, 0.5), 1.5)
    clock = SystemClock()
    devices = Devices(hardware.pan_tilt, hardware.cameras, limits, stored.digest, clock, stored.rig)
    steps: list[Step] = []

    def point(**target: Any) -> PointingResult:
        loop = PointingLoop(stored.rig, devices, clock, steps.append, threading.Event())
        return loop.run(PointRequest(**target))

    try:
        point(pan_rad=-0.3, tilt_rad=-0.5)
        clicked = devices.frames(["navcam_left"], clock.now_s(), 5.0)["navcam_left"]
        spot_px = (600, 330)
        target = PixelTarget("navcam_left", clicked.frame_id, *spot_px)
        result = point(pixel=target, pointings=2)
        after = devices.store.by_id(result["pointings"][-1]["frame_id"])
    finally:
        devices.close()
    assert [step["name"] for step in steps].count("measure") == 2
    assert all(step["state"] == "done" for step in steps)
    for pointing in result["pointings"]:
        assert pointing["residual_px"] is not None
        # The rig is exact, the head has no counts and no play: nothing but the matching is left.
        assert np.abs(pointing["residual_px"]).max() < 0.2
    x, y = spot_px
    score = cv2.matchTemplate(
        after.image, clicked.image[y - 15 : y + 16, x - 15 : x + 16], cv2.TM_CCOEFF_NORMED
    )
    landed_px = np.array(cv2.minMaxLoc(score)[3]) + 15
    centre_px = stored.rig.cameras["navcam_left"].model.image_center_px
    assert np.abs(landed_px - centre_px).max() < LANDED_WITHIN_PX + 0.5


def test_it_runs_on_any_clock_beside_its_configuration_and_can_be_halted(
    installed: Path, mast_file: Path
) -> None:
    """What only drivers of this repository could do once."""
    camera = DeviceSettings("bench_rig", {"mast_file": mast_file.name})
    settings = HardwareSettings(
        DeviceSettings("bench_rig"), {"navcam_left": camera}, {"speed": "max"}, mast_file.parent
    )
    clock = clock_for(settings)
    with open_hardware(settings, clock) as hardware, clock.at_work():
        hardware.pan_tilt.move(0.5, 0.0)
        clock.sleep(10.0)
        assert hardware.pan_tilt.read().pan_rad == 0.5
        assert hardware.cameras["navcam_left"].info.size_px == (1024, 768)
        asked_s = clock.now_s()
        assert hardware.cameras["navcam_left"].next_frame(asked_s, 1.0).exposure_began_s > asked_s
    assert halt_head(settings) == ["it is in memory: nothing turns"]


def test_drivers_of_installed_packages_are_found_by_their_names(installed: Path) -> None:
    with open_hardware(HardwareSettings(DeviceSettings("bench_rig"), {})) as hardware:
        assert Path(str(sys.modules[type(hardware.pan_tilt).__module__].__file__)).is_relative_to(installed)
    with pytest.raises(BadOptions, match=r"no driver 'bench_rib'; did you mean 'bench_rig'"):
        open_hardware(HardwareSettings(DeviceSettings("bench_rib"), {}))


def test_a_name_that_two_packages_offer_is_refused_and_reported(
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
    assert (late.kind, late.name, late.path, late.package) == (
        "head", "late_rig", "late:head", "late-rig 1.0",
    )  # fmt: skip
