"""What is wrong with the daemon's own files is told like what is wrong with a device."""

from __future__ import annotations

from pathlib import Path

import pytest

from hil_tests.mastctl.service_fakes import fake_daemon
from hil_tests.waiting import until
from mastctl.client import Client
from mastctl.control.standing import StandingFault

FULL = StandingFault("a file", "full", "the disk is full", 1.0, "it is not")


@pytest.mark.parametrize("part", ["handoffs", "recorder", "audit"])
def test_each_own_fault_is_published_and_in_the_status(
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
