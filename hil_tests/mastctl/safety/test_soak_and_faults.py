"""Short forms of campaigns that docs/evidence/safety.md reports: a soak, and faults under way."""

from __future__ import annotations

import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from hil_tests.waiting import joined, until
from tools.campaigns import soak as campaign
from tools.campaigns import soak_clients
from tools.campaigns.faults import trials
from tools.campaigns.soak_ledger import EVERYTHING, Ledger
from tools.living_daemon import Vitals


@pytest.mark.long(2, "a soak in small, 15 s of processor time")
def test_a_daemon_among_faults_and_bad_clients_does_as_wanted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """So short a run has no warm-up: whether the daemon grows is the long one's question."""
    monkeypatch.setattr(campaign, "WEIGH_S", 0.0)
    monkeypatch.setattr(campaign.Crowd, "warm_up", lambda crowd, least_s, operations: crowd.work(1.0))
    monkeypatch.setattr(campaign, "judge", lambda first, last, ledger: None)
    assert campaign.soak(tmp_path, "memory", 3.0, seed=3, settle_s=0.5, rests=1) == []


@pytest.mark.long(4, "three minutes: memory, threads and descriptors are weighed after a warm-up")
def test_a_daemon_among_faults_and_bad_clients_stays_the_same(tmp_path: Path) -> None:
    assert campaign.soak(tmp_path, "memory", 60.0, seed=3, rests=1) == []


def test_the_warm_up_ends_when_everything_was_done_once_and_enough_operations_have_ended() -> None:
    ledger = Ledger()
    *others, last = sorted(EVERYTHING)
    warming = threading.Thread(target=campaign.Crowd(0, 1, ledger).warm_up, args=(0.0, 1), daemon=True)
    warming.start()
    for what in others:
        ledger.act(what)
    until(lambda: ledger.lacking() == {last}, "all but one")
    warming.join(1.0)
    assert warming.is_alive()
    ledger.act(last)
    warming.join(1.0)
    assert warming.is_alive(), "no operation has ended"
    ledger.operation_ended("angles", {"state": "done", "created_s": 0.0, "ended_s": 1.0}, 5.0)
    joined(warming)
    assert ledger.wrong == []


def test_a_warm_up_that_lacks_something_says_what(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(soak_clients, "WARM_S", 0.0)
    ledger = Ledger()
    for what in EVERYTHING - {"jog done"}:
        ledger.act(what)
    campaign.Crowd(0, 1, ledger).warm_up(0.0)
    assert ledger.wrong == ["not warm after 0 s: ['jog done']"]


def test_a_moment_between_two_files_is_not_what_a_daemon_weighs() -> None:
    at_rest, between = Vitals(500.0, 30, 49, 1.0, {}), Vitals(480.0, 29, 47, 1.0, {})
    lighter, leaving = replace(at_rest, rss_mb=490.0), Vitals(470.0, 31, 50, 1.0, {})
    assert campaign.usual([leaving, at_rest, between, lighter, at_rest]) == lighter


@pytest.mark.parametrize(
    ("more", "said"),
    [
        ({"rss_mb": 120.5}, "memory grew by 20.5 MB, 20 allowed"),
        ({"threads": 9}, "1 threads more than after the warm-up"),
        (
            {"descriptors": 22, "open_files": {"socket": 5}},
            "2 descriptors more than after the warm-up: {'socket': 2}",
        ),
    ],
)
def test_a_daemon_that_has_grown_is_not_as_wanted(more: dict[str, Any], said: str) -> None:
    first = Vitals(100.0, 8, 20, 1.0, {"socket": 3})
    ledger = Ledger()
    campaign.judge(first, replace(first, rss_mb=119.9, cpu_s=9.0), ledger)
    assert ledger.wrong == []
    campaign.judge(first, replace(first, **more), ledger)
    assert ledger.wrong == [said]


@pytest.mark.long(
    4, "a whole daemon in real time for each; motion/test_pointing_faults.py has each fault quickly"
)
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
