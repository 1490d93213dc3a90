"""The answers about head, cameras and faults, and faults of the daemon's own files."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hil_tests.mastctl.service_fakes import fake_daemon, newest, on_disk
from hil_tests.waiting import until
from mastctl.client import Client
from mastctl.control.machine import StandingFault
from mastctl.devices.frames import StampedFrame
from mastctl.devices.joint_history import HeadReading
from mastctl.drift import journal
from mastctl.panorama.panoramas import Panoramas
from mastctl.service.service import camera_answer, joints_answer

READING = HeadReading(0.1, -0.2, False, 99.75, true_rad=(0.103, -0.198), approach=(1.0, 0.0))
FAULT = StandingFault("navcam_left", "no_reply", "the camera is silent", 98.5, "it answers")
FULL = StandingFault("a file", "full", "the disk is full", 1.0, "it is not")
FACTS = ("id", "navcam_left", 7, 99.5, 0.01, 0.0, 0.0, False, "digest", np.zeros((2, 2), np.uint8))
FRAME = StampedFrame(*FACTS, true_pan_rad=0.0, true_tilt_rad=0.0)


def test_ages_count_to_one_moment_and_are_never_below_zero() -> None:
    for now_s, ages_s in ((100.0, (0.25, 0.5, 1.5)), (95.0, (0.0, 0.0, 0.0))):
        camera, fault = camera_answer(FRAME, now_s), FAULT.as_json(now_s)
        assert (joints_answer(READING, now_s)["age_s"], camera["age_s"], fault["for_s"]) == ages_s
    assert (camera["frame_id"], camera["sequence"], camera["exposure_s"]) == ("id", 7, 0.01)


@pytest.mark.parametrize("part", ["drift", "recorder", "entry"])
def test_each_own_fault_is_published_and_in_the_status(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, part: str
) -> None:
    with fake_daemon(monkeypatch, tmp_path) as (daemon, _), Client(daemon.url) as client:
        publisher = daemon.service.machine.publisher
        with monkeypatch.context() as patch:
            patch.setattr(getattr(daemon.service, part), "faults", lambda: (FULL,))
            until(lambda: newest(publisher, "fault", "a file") == (FULL,), "the fault")
            assert ("a file", "full") in [(one["device"], one["code"]) for one in client.status()["faults"]]
            assert client.status()["state"] != "fault", "the head is well"
        until(lambda: newest(publisher, "fault", "a file") == (), "the fault's end")


def test_the_drift_watch_begins_when_all_that_it_reads_is_there(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    defects: list[str] = []
    monkeypatch.setattr(journal.log, "exception", defects.append)
    monkeypatch.setattr(Panoramas, "__init__", _slow(Panoramas.__init__))
    with fake_daemon(monkeypatch, tmp_path) as (daemon, _):
        on_disk(daemon.service.journals)
    assert defects == []


def _slow(begin: Callable[..., None]) -> Callable[..., None]:
    """The beginning of a part, on a machine on which other threads come first."""

    def later(*args: Any) -> None:
        time.sleep(0.2)
        begin(*args)

    return later
