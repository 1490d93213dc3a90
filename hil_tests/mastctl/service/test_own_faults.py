"""What is wrong with the daemon's own files is told like what is wrong with a device."""

from __future__ import annotations

from pathlib import Path

import pytest

from calib.errors import BadFile
from hil_tests.mastctl.service_fakes import fake_daemon
from hil_tests.waiting import until
from mastctl.client import Client
from mastctl.control.standing import StandingFault
from mastctl.safety.state_file import StateFile

FULL = StandingFault("a file", "full", "the disk is full", 1.0, "it is not")


@pytest.mark.parametrize("part", ["handoffs", "recording", "audit"])
def test_each_change_is_published_although_nobody_asks_and_the_status_has_it(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, part: str
) -> None:
    with fake_daemon(monkeypatch, tmp_path) as (daemon, _), Client(daemon.url) as client:
        publisher = daemon.service.machine.publisher
        with monkeypatch.context() as patch:
            patch.setattr(getattr(daemon.service, part), "faults", lambda: (FULL,))
            until(lambda: publisher.newest("fault", "a file") == (FULL,), "the fault")
            assert ("a file", "full") in [(one["device"], one["code"]) for one in client.status()["faults"]]
            assert client.status()["state"] != "fault", "the head is well"
        until(lambda: publisher.newest("fault", "a file") == (), "the fault's end")


def test_an_emergency_stop_that_the_disk_does_not_take_is_published_as_a_fault(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    config = """
schema: mastctl/config/1
mast_file: little.yaml
listen: {listen}
pan_tilt: {{driver: fake}}
cameras: {{navcam_left: {{driver: fake}}, navcam_right: {{driver: fake}}, hazcam_left: {{driver: fake}}}}
limits: {{pan_rad: [-2.0, 2.0], tilt_rad: [-1.0, 1.0], speed_rad_per_s: 0.5}}
state: {{folder: state}}
"""
    with fake_daemon(monkeypatch, tmp_path, config=config) as (daemon, _), Client(daemon.url) as client:
        publisher = daemon.service.machine.publisher

        def refuse(file: StateFile, document: object) -> None:
            raise BadFile(file.path, "", "cannot be saved: No space left on device")

        with monkeypatch.context() as patch:
            for way in ("write", "overwrite"):
                patch.setattr(StateFile, way, refuse)
            assert client.estop(reason="smoke")["kept"] is False
            until(
                lambda: [one.code for one in publisher.newest("fault", "state") or ()] == ["latch_not_kept"],
                "the fault",
            )
        until(lambda: publisher.newest("fault", "state") == (), "the fault's end")
