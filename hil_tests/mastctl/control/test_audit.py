"""The record of commands: whole lines in a bounded file, and nobody who waits for the disk."""

from __future__ import annotations

import errno
import json
import os
import threading
from pathlib import Path
from typing import Any

import pytest

from hil_tests.mastctl.service_fakes import Hang
from hil_tests.waiting import NET_S
from mastctl.control import audit as audit_module
from mastctl.control.audit import WAITING, AuditLog


def lines(path: Path) -> list[dict[str, Any]]:
    """The lines of a file, each of which must be whole."""
    text = path.read_text()
    assert text == "" or text.endswith("\n")
    return [json.loads(line) for line in text.splitlines()]


class Disk:
    """Stands for `os.write`: ``room`` bytes fit, the rest is ENOSPC."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.room: int | None = None
        self.hook = lambda: None
        self._write = os.write
        monkeypatch.setattr(audit_module.os, "write", self.write)

    def write(self, descriptor: int, data: bytes) -> int:
        if threading.current_thread().name != "audit log":
            return self._write(descriptor, data)
        self.hook()
        if self.room is not None:
            if self.room == 0:
                raise OSError(errno.ENOSPC, "No space left on device")
            data = data[: self.room]
            self.room -= len(data)
        return self._write(descriptor, data)


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> Disk:
    return Disk(monkeypatch)


def test_each_record_is_a_line_in_a_file_that_nobody_else_reads(tmp_path: Path) -> None:
    log = AuditLog(tmp_path / "state" / "audit.jsonl")
    for number in range(3):
        log.put({"number": number})
    assert log.flush()
    assert [line["number"] for line in lines(tmp_path / "state" / "audit.jsonl")] == [0, 1, 2]
    assert (tmp_path / "state" / "audit.jsonl").stat().st_mode & 0o777 == 0o600
    log.close()


def test_a_new_run_goes_on_after_the_last_whole_line(tmp_path: Path) -> None:
    path = tmp_path / "audit.jsonl"
    path.write_bytes(b'{"number":0}\n{"numb')
    log = AuditLog(path)
    log.put({"number": 1})
    log.close()
    assert [line["number"] for line in lines(path)] == [0, 1]


@pytest.mark.parametrize("room", [0, 1, 7, 13])
def test_a_full_disk_leaves_whole_lines_and_what_was_lost_is_told_there(
    tmp_path: Path, disk: Disk, room: int
) -> None:
    path = tmp_path / "audit.jsonl"
    log = AuditLog(path)
    log.put({"number": 0})
    assert log.flush()
    disk.room = room
    for number in range(1, 4):
        log.put({"number": number})
    assert log.flush()
    first = [0, 1] if room == 13 else [0]
    assert [line["number"] for line in lines(path)] == first
    (fault,) = log.faults()
    assert (fault.code, fault.device) == ("not_recorded", "audit_log")
    assert "No space left on device" in fault.message
    disk.room = None
    log.put({"number": 4})
    assert log.flush()
    assert log.faults() == ()
    told = lines(path)[len(first) :]
    assert (told[0]["lost"], told[1]["number"]) == (4 - len(first), 4)
    log.close()


def test_a_disk_that_hangs_blocks_no_caller_and_losses_are_counted(tmp_path: Path, disk: Disk) -> None:
    path, hang = tmp_path / "audit.jsonl", Hang()
    disk.hook = hang
    log = AuditLog(path)
    log.put({"number": 0})
    assert hang.entered.wait(NET_S)
    for number in range(1, WAITING + 51):
        log.put({"number": number})  # returns, or the test never ends
    hang.let_go()
    assert log.flush(NET_S)
    log.put({"number": -1})
    assert log.flush(NET_S)
    told = lines(path)
    assert sum(line.get("lost", 0) for line in told) == 50
    assert len([line for line in told if "number" in line]) == WAITING + 2
    log.close()


def test_files_are_bounded_and_the_oldest_goes(tmp_path: Path) -> None:
    log = AuditLog(tmp_path / "audit.jsonl", file_bytes=200, files=3)
    for number in range(100):
        log.put({"number": number})
    assert log.flush(NET_S)
    log.close()
    names = ["audit.jsonl.2", "audit.jsonl.1", "audit.jsonl"]
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(names)
    assert all((tmp_path / name).stat().st_size <= 200 for name in names)
    kept = [line["number"] for name in names for line in lines(tmp_path / name)]
    assert kept == list(range(100 - len(kept), 100))
    assert len(kept) > 20
