"""A pointing through the replay driver, behind the same doors as live hardware."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from calib.geometry.pointing import solve
from calib.geometry.stereo import triangulate
from calib.matching.patch import match_patch
from calib.matching.warp import Plane, PosedImage, grey
from drivers.clock import ManualClock
from drivers.hardware import DeviceSettings, HardwareSettings
from drivers.open_hardware import open_hardware
from drivers.recordings.replay import NoRecording

FOUND_PX = 3.0
SOLVED_RAD = 5e-6
CAMERA = "navcam_left"


def test_pointing_at_a_feature_goes_to_the_recorded_angles_and_finds_it(
    mer: ModuleType, mer_folder: Path
) -> None:
    products = mer.labels(mer_folder)
    rover = mer.rig(mer.fit(products), products)
    clock = ManualClock(10.0)
    device = DeviceSettings("replay", {"products": "1N4910*.IMG", "camera": CAMERA})
    settings = HardwareSettings(device, {CAMERA: device}, folder=mer_folder)
    with open_hardware(settings, clock) as hardware:
        assert hardware.kind == "replayed"
        head, camera = hardware.pan_tilt, hardware.cameras[CAMERA]

        # A person clicks the foot of the rock at the edge of the third frame; the fourth tells its range.
        third, fourth = products[2], products[3]
        head.move(third.azimuth_measured_rad, third.elevation_measured_rad)
        here = head.read()
        clicked = grey(camera.next_frame(clock.now_s(), 1.0).image)
        clicked_camera = rover.camera_in_rover(CAMERA, here.pan_rad, here.tilt_rad)
        clicked_px = np.array([990.0, 351.0])
        target = triangulate(clicked_camera, fourth.camera_model, clicked_px, [142.7, 221.7]).position_m
        aim_px, _ = fourth.camera_model.project(target)

        best = solve(rover.mast, rover.cameras[CAMERA].model, target, aim_px, from_pan_rad=here.pan_rad)[0]
        assert best.pan_rad == pytest.approx(fourth.azimuth_measured_rad, abs=SOLVED_RAD)
        assert best.tilt_rad == pytest.approx(fourth.elevation_measured_rad, abs=SOLVED_RAD)

        head.move(best.pan_rad, best.tilt_rad)
        there = head.read()
        assert (there.pan_rad, there.tilt_rad) == (
            fourth.azimuth_measured_rad,
            fourth.elevation_measured_rad,
        )
        moved_s = clock.now_s()
        frame = camera.next_frame(moved_s, 1.0)
        assert frame.mid_exposure_s - frame.exposure_s / 2 > moved_s
        found = match_patch(
            PosedImage(clicked, clicked_camera),
            clicked_px,
            Plane(target, np.array([0.0, 0.0, -1.0])),
            PosedImage(grey(frame.image), rover.camera_in_rover(CAMERA, there.pan_rad, there.tilt_rad)),
            search_px=12.0,
        )
        assert found.verdict == "good", found.reason
        assert np.linalg.norm(found.pixel_px - aim_px) < FOUND_PX

        centre = solve(rover.mast, rover.cameras[CAMERA].model, target)[0]
        with pytest.raises(NoRecording, match=r"nearest recording is at pan 2\.15666, tilt -0\.616709"):
            head.move(centre.pan_rad, centre.tilt_rad)
        assert head.read().pan_rad == there.pan_rad


def test_all_frames_share_one_grey_scale(mer: ModuleType, mer_folder: Path) -> None:
    recording = mer.replay(mer_folder, ManualClock())
    scales = {pointing.frames[CAMERA].scale for pointing in recording.pointings}
    assert len(scales) == 1
