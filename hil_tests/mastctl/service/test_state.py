"""The snapshot that status tells, made by hand: the word for it, and ages against its own moment."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from drivers.interfaces import AxisMotion
from hil_tests.waiting import present
from mastctl.control.standing import Standing, StandingFault
from mastctl.devices.frames import StampedFrame
from mastctl.devices.joint_history import HeadReading
from mastctl.devices.limits import Limits
from mastctl.motion.track import TrackStatus
from mastctl.service.state import State

REST = State(
    now_s=100.0,
    started_s=40.0,
    version="1",
    hardware="real",
    mast={"file": "a.yaml", "name": "a", "digest": "0"},
    former_mast=None,
    limits=Limits((-2.0, 2.0), (-1.0, 1.0), 0.5),
    axes={"pan": AxisMotion(1.0, 0.1, math.inf, 5e-5), "tilt": AxisMotion(1.0)},
    reading=HeadReading(0.1, -0.2, False, 99.75, true_rad=(0.103, -0.198), approach=(1.0, 0.0)),
    frames={"navcam_left": None},
    standing=Standing("ready", "", 90.0),
    track=TrackStatus(),
    faults=(),
)
OF_THE_HEAD = StandingFault("head", "no_reply", "the head is silent", 98.5, "it answers")
OF_A_CAMERA = replace(OF_THE_HEAD, device="navcam_left")


def test_ages_count_to_the_moment_of_the_snapshot_and_are_never_below_zero() -> None:
    frame = StampedFrame(
        "id",
        "navcam_left",
        7,
        99.5,
        0.01,
        0.0,
        0.0,
        False,
        "digest",
        np.zeros((2, 2), np.uint8),
        true_pan_rad=0.0,
        true_tilt_rad=0.0,
    )
    state = replace(REST, frames={"navcam_left": frame}, faults=(OF_A_CAMERA,))
    for later_s, ages_s in ((0.0, (0.25, 0.5, 1.5, 60.0)), (-5.0, (0.0, 0.0, 0.0, 55.0))):
        told = replace(state, now_s=100.0 + later_s).told()
        camera, fault = told["cameras"]["navcam_left"], told["faults"][0]
        assert (present(told["joints"])["age_s"], camera["age_s"], fault["for_s"], told["uptime_s"]) == ages_s
    assert (camera["frame_id"], camera["sequence"], camera["exposure_s"]) == ("id", 7, 0.01)


def test_what_is_not_known_yet_is_null() -> None:
    told: Any = replace(REST, reading=None).told()
    names = ("joints", "operation", "target", "last_residual", "pose", "former_mast")
    assert [told[name] for name in names] == [None] * len(names)
    assert set(told["cameras"]["navcam_left"].values()) == {None}
