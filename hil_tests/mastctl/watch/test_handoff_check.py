"""The self-check in service: what hand-offs say together, and a record that cannot be written."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calib.files.mast_file import load_rig
from calib.geometry.rig import Rig
from calib.matching.handoff import MatchedHandoff
from drivers.clock import ManualClock
from hil_tests.calib.matching.handed_over import (
    HAZCAMS,
    hand_offs,
    moved_hazcams,
    pixel,
    plain_rig,
    targets,
    vectors,
)
from hil_tests.mastctl.service_fakes import Hang
from hil_tests.waiting import until
from mastctl.watch import journal
from mastctl.watch.handoffs import NAME, HandoffCheck, read_log
from mastctl.watch.journal import Journal, JournalThread

DIGEST, OTHER = "d" * 64, "e" * 64


@pytest.fixture(scope="module")
def rig(repository: Path) -> Rig:
    return plain_rig(load_rig(repository / "configs/sim/rocky8.yaml").rig)


def handed(rig: Rig, count: int, yaw_rad: float = 0.0, digest: str = DIGEST) -> list[MatchedHandoff]:
    """Hand-offs by a mast file from which the true Hazcams are turned; matches with 0.3 px of noise."""
    rng = np.random.default_rng(4)
    points = targets(rng, count)
    true = moved_hazcams(rig, Rotation.from_rotvec((0.0, 0.0, yaw_rad)), (0.0, 0.0, 0.0))
    made = hand_offs(true, rig, points, rng, match_px=0.3, digest=digest)
    believed = {name: vectors(rig, name) for name in HAZCAMS}
    return [
        replace(
            one,
            landed={
                name: replace(
                    landed,
                    geometric_px=pixel(believed[name], point),
                    geometric_covariance_px2=0.04 * np.eye(2),
                )
                for name, landed in one.landed.items()
            },
        )
        for one, point in zip(made, points, strict=True)
    ]


@pytest.fixture
def thread() -> Iterator[JournalThread]:
    made = JournalThread(ManualClock(10.0))
    yield made
    made.close()


def check(path: Path | None, thread: JournalThread) -> HandoffCheck:
    return HandoffCheck(path, DIGEST, ManualClock(10.0), thread)


def test_a_turned_body_pair_is_reported_after_enough_hand_offs(
    rig: Rig, tmp_path: Path, caplog: pytest.LogCaptureFixture, thread: JournalThread
) -> None:
    first, *others = handed(rig, 20, yaw_rad=0.004)  # turned to the right: targets appear further left
    selfcheck = check(tmp_path / "h.jsonl", thread)
    selfcheck.add(first)
    assert selfcheck.summary() == {"handoffs": 1, "offsets": []}
    for one in others:
        selfcheck.add(one)
    summary = selfcheck.summary()
    assert summary["handoffs"] == 20
    assert [one["camera"] for one in summary["offsets"]] == list(HAZCAMS)
    for offset in summary["offsets"]:
        model = rig.cameras[offset["camera"]].model
        focal_px = float(np.linalg.norm(np.cross(model.A, model.H)))
        assert offset["offset_px"] == pytest.approx([-0.004 * focal_px, 0.0], abs=0.5)
        assert offset["sigmas"] > 5.0
        assert f"{offset['camera']} sees targets" in offset["sentence"]
        assert "px left" in offset["sentence"] and "of where navcam puts them" in offset["sentence"]
    assert sum("show an offset: hazcam_left" in line for line in caplog.messages) == 1, "logged once"
    thread.close()
    assert len(read_log(tmp_path / "h.jsonl").handoffs) == 20


def test_only_hand_offs_of_the_mast_file_in_use_count(rig: Rig, thread: JournalThread) -> None:
    selfcheck = check(None, thread)
    for one in [*handed(rig, 12, 0.004), *handed(rig, 5, 0.0, OTHER)]:
        selfcheck.add(one)
    assert (selfcheck.summary()["handoffs"], len(selfcheck.summary()["offsets"])) == (12, 2)
    selfcheck.use_mast(OTHER)
    assert selfcheck.summary() == {"handoffs": 5, "offsets": []}
    selfcheck.use_mast(DIGEST)
    assert len(selfcheck.summary()["offsets"]) == 2


def test_a_record_that_cannot_be_written_is_a_fault_and_nothing_else(rig: Rig, thread: JournalThread) -> None:
    path = Path("/dev/full")
    selfcheck = check(path, thread)
    for one in handed(rig, 12, 0.004):
        selfcheck.add(one)
    assert len(selfcheck.summary()["offsets"]) == 2
    until(lambda: any(one.code == "unwritable" for one in selfcheck.faults()), "the fault")
    fault = selfcheck.faults()[-1]
    assert fault.device == NAME
    assert fault.message.startswith(str(path)) and "hand-offs count, and wait" in fault.message
    assert "\n" not in fault.message


def test_a_file_that_hangs_keeps_nobody_waiting(
    rig: Rig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    hang, clock, file_time = Hang(), ManualClock(10.0), ManualClock()
    monkeypatch.setattr(Journal, "append", lambda self, *_: hang())
    monkeypatch.setattr(journal, "CLOSE_S", 0.05)
    before = set(threading.enumerate())
    thread = JournalThread(clock, file_time)
    selfcheck = HandoffCheck(tmp_path / "h.jsonl", DIGEST, clock, thread)
    for one in handed(rig, 3):
        selfcheck.add(one)
    assert hang.entered.wait(60.0)
    assert (selfcheck.summary()["handoffs"], thread.faults()) == (3, ())
    clock.advance(60.0)  # a simulated rover's minute may be a moment of the file's
    assert thread.faults() == ()
    file_time.advance(60.0)
    (fault,) = thread.faults()
    assert (fault.code, fault.since_s) == ("slow", 10.0)
    assert "does not answer" in fault.message
    thread.close()
    hang.let_go()
    until(
        lambda: not any(t.name == journal.NAME for t in {*threading.enumerate()} - before), "its thread ends"
    )
