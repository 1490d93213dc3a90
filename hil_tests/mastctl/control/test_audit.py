"""The record of commands: whole lines in a bounded file, and no caller that waits for the disk."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from drivers.clock import SystemClock
from hil_tests.mastctl.service_fakes import Hang, on_disk
from hil_tests.waiting import NET_S
from mastctl.control.entry import WAITING, AuditLog
from mastctl.drift.journal import JournalThread

CLOCK = SystemClock()


@pytest.fixture
def thread() -> Iterator[JournalThread]:
    made = JournalThread(CLOCK)
    yield made
    made.close()


def lines(path: Path) -> list[dict[str, Any]]:
    """The lines of a file, each of which must be whole."""
    text = path.read_text()
    assert text == "" or text.endswith("\n")
    return [json.loads(line) for line in text.splitlines()]


def test_each_record_is_a_line_in_a_file_that_no_other_user_reads(
    tmp_path: Path, thread: JournalThread
) -> None:
    log = AuditLog(tmp_path / "state" / "audit.jsonl", thread.put, CLOCK)
    for number in range(3):
        log.put({"number": number})
    on_disk(thread)
    assert [line["number"] for line in lines(tmp_path / "state" / "audit.jsonl")] == [0, 1, 2]
    assert (tmp_path / "state" / "audit.jsonl").stat().st_mode & 0o777 == 0o600


def test_a_new_run_goes_on_after_the_last_whole_line(tmp_path: Path, thread: JournalThread) -> None:
    path = tmp_path / "audit.jsonl"
    path.write_bytes(b'{"number":0}\n{"numb')
    AuditLog(path, thread.put, CLOCK).put({"number": 1})
    on_disk(thread)
    assert [line["number"] for line in lines(path)] == [0, 1]


ON_A_FULL_DISK = """
import json, resource, sys
from pathlib import Path
from drivers.clock import SystemClock
from mastctl.control.entry import AuditLog

log = AuditLog(Path(sys.argv[1]), lambda write: write(), SystemClock())
log.put({"number": 0})
hard = resource.getrlimit(resource.RLIMIT_FSIZE)[1]
resource.setrlimit(resource.RLIMIT_FSIZE, (Path(sys.argv[1]).stat().st_size + int(sys.argv[2]), hard))
for number in range(1, 4):
    log.put({"number": number})
(fault,) = log.faults()
resource.setrlimit(resource.RLIMIT_FSIZE, (hard, hard))
log.put({"number": 4})
print(json.dumps([fault.code, fault.device, fault.message, len(log.faults())]))
"""


@pytest.mark.parametrize("room", [0, 1, 7, 13])
def test_a_full_disk_leaves_whole_lines_and_the_number_of_lost_ones(tmp_path: Path, room: int) -> None:
    path = tmp_path / "audit.jsonl"
    command = [sys.executable, "-B", "-c", ON_A_FULL_DISK, str(path), str(room)]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=NET_S)
    code, device, message, faults_after = json.loads(done.stdout)
    assert (code, device, faults_after) == ("not_recorded", "audit_log", 0)
    assert "File too large" in message
    *first, lost, last = lines(path)
    assert [line["number"] for line in first] == ([0, 1] if room == 13 else [0])
    assert (lost["lost"], last["number"]) == (4 - len(first), 4)


def test_a_disk_that_hangs_blocks_no_caller_and_losses_are_counted(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, thread: JournalThread
) -> None:
    path, hang, sync = tmp_path / "audit.jsonl", Hang(), os.fdatasync

    def hanging(descriptor: int) -> None:
        hang()
        sync(descriptor)

    monkeypatch.setattr("os.fdatasync", hanging)
    log = AuditLog(path, thread.put, CLOCK)
    log.put({"number": 0})
    assert hang.entered.wait(NET_S)
    for number in range(1, WAITING + 51):
        log.put({"number": number})  # returns, or the test never ends
    hang.let_go()
    on_disk(thread)
    log.put({"number": -1})
    on_disk(thread)
    told = lines(path)
    assert sum(line.get("lost", 0) for line in told) == 50
    assert len([line for line in told if "number" in line]) == WAITING + 2


def test_files_are_bounded_and_the_oldest_goes(tmp_path: Path, thread: JournalThread) -> None:
    log = AuditLog(tmp_path / "audit.jsonl", thread.put, CLOCK, file_bytes=200, files=3)
    for number in range(100):
        log.put({"number": number})
    on_disk(thread)
    names = ["audit.jsonl.2", "audit.jsonl.1", "audit.jsonl"]
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(names)
    assert all((tmp_path / name).stat().st_size <= 200 for name in names)
    kept = [line["number"] for name in names for line in lines(tmp_path / name)]
    assert kept == list(range(100 - len(kept), 100))
    assert len(kept) > 20
