"""Short forms of the campaigns whose long ones docs/safety.md reports: a soak, and faults under way."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from tools.campaigns.faults import trials
from tools.campaigns.soak import soak
from tools.campaigns.soak_ledger import Ledger


def test_a_daemon_among_faults_and_bad_clients_stays_the_same(tmp_path: Path) -> None:
    wrong = soak(tmp_path, "memory", 10.0, seed=3, settle_s=0.5, rests=1)
    # so short a run has no warm-up: memory, threads and descriptors are the long one's
    assert [
        one for one in wrong if "memory grew" not in one and " more than after the warm-up" not in one
    ] == []


@pytest.mark.parametrize("during", ["pointing", "tracking"])
def test_a_fault_under_way_is_told_ends_what_it_must_and_is_over_when_it_is_over(
    during: str, tmp_path: Path
) -> None:
    head, camera = trials(tmp_path, "memory", during, ["off"])
    assert (head.device, head.told, head.states[-1]) == ("pan_tilt", "no_reply", "fault")
    assert head.ended == "failed no_reply"
    if during == "pointing":  # a look at a track can do with the pictures of before
        assert camera.told == "no_fresh_frame"
    assert "fault" not in camera.states  # a camera's fault is no state of the head
    assert all(one.well_s is not None and not one.lost for one in (head, camera))


def test_what_no_fault_explains_is_not_as_wanted() -> None:
    ledger, now_s = Ledger(), time.monotonic()
    record = {
        "state": "failed",
        "error": {"code": "no_reply", "message": "x"},
        "created_s": 0.0,
        "ended_s": 9.0,
    }
    ledger.operation_ended("angles", record, 5.0)
    ledger.answer("looker", "GET /status", 500, "internal", now_s, "x")
    assert len(ledger.wrong) == 2
    ledger.fault_set("pan_tilt", "off", now_s - 1.0, now_s)
    ledger.answer("looker", "GET /status", 504, "no_reply", now_s, "x")
    assert len(ledger.wrong) == 2  # explained
    ledger.answer("looker", "GET /status", 500, "internal", now_s, "x")
    ledger.operation_ended("angles", {**record, "created_s": now_s - 20.0, "ended_s": now_s}, 5.0)
    assert len(ledger.wrong) == 4  # a defect, and a deadline that was missed by far
