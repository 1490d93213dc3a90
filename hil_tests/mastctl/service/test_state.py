"""The answers about head, cameras and faults: ages against one moment, null for what is not known."""

from __future__ import annotations

import numpy as np

from mastctl.control.standing import StandingFault
from mastctl.devices.frames import StampedFrame
from mastctl.devices.joint_history import HeadReading
from mastctl.service.state import camera_answer, fault_answer, joints_answer

READING = HeadReading(0.1, -0.2, False, 99.75, true_rad=(0.103, -0.198), approach=(1.0, 0.0))
FAULT = StandingFault("navcam_left", "no_reply", "the camera is silent", 98.5, "it answers")
FACTS = ("id", "navcam_left", 7, 99.5, 0.01, 0.0, 0.0, False, "digest", np.zeros((2, 2), np.uint8))
FRAME = StampedFrame(*FACTS, true_pan_rad=0.0, true_tilt_rad=0.0)


def test_ages_count_to_one_moment_and_are_never_below_zero() -> None:
    for now_s, ages_s in ((100.0, (0.25, 0.5, 1.5)), (95.0, (0.0, 0.0, 0.0))):
        camera, fault = camera_answer(FRAME, now_s), fault_answer(FAULT, now_s)
        assert (joints_answer(READING, now_s)["age_s"], camera["age_s"], fault["for_s"]) == ages_s
    assert (camera["frame_id"], camera["sequence"], camera["exposure_s"]) == ("id", 7, 0.01)


def test_what_is_not_known_of_a_camera_yet_is_null() -> None:
    assert set(camera_answer(None, 100.0).values()) == {None}
