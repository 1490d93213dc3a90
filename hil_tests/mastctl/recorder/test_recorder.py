"""The recorder in a daemon's place: bounds, faults, a disk that is slow, full or gone, and a kill."""

from __future__ import annotations

import errno
import json
import os
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from drivers.clock import ManualClock
from drivers.recordings.mcap_file import McapContents, McapEntry, read_items
from hil_tests.mastctl.recorder.recorder_world import (
    Recording,
    files,
    frame,
    mast,
    messages,
    picture,
    reading,
    records,
)
from hil_tests.support.kills import kills
from hil_tests.waiting import until
from mastctl.control import publisher
from mastctl.control.machine import StandingFault
from mastctl.errors import NotNow, Unable
from mastctl.recorder import recorder as module
from mastctl.recorder.entries import AttachedMast, Entries
from mastctl.recorder.folder import RecordFolder
from mastctl.recorder.writer import Attached, RecordFile

FAULT = StandingFault("pan_tilt", "no_reply", "it does not answer", 1.0, "it answers")


def kinds(folder: Path) -> dict[str, list[str]]:
    found: dict[str, list[str]] = {}
    for one in RecordFolder(folder).all():
        found.setdefault(one.kind, []).append(one.name)
    return found


def test_killed_at_any_moment_it_leaves_all_but_the_end_and_that_is_whole(tmp_path: Path) -> None:
    results = kills(8, 7, tmp_path)
    assert [one.wrong for one in results if one.wrong] == []
    assert all(one.recorded for one in results)


def test_nothing_is_recorded_without_a_ring_until_a_run_begins(tmp_path: Path) -> None:
    one = Recording(tmp_path, ring_s=0.0)
    one.publish("command", "1", {"number": 1})
    one.publish("state", "machine", {"word": "ready"})
    assert one.summary()["recording"] is False
    assert one.recorder.start_run("my rock")["run"].endswith("-my-rock")
    one.publish("command", "2", {"number": 2})
    with pytest.raises(NotNow, match="is recorded already"):
        one.recorder.start_run("another")
    ended = one.recorder.stop_run()
    one.publish("command", "3", {"number": 3})
    with pytest.raises(NotNow, match="no run is recorded"):
        one.recorder.stop_run()
    one.recorder.close()
    (path,) = files(tmp_path)
    assert str(path) == ended["file"]
    assert [one["number"] for one in records(path, "/command")] == [2]
    assert records(path, "/state") == [{"word": "ready"}]  # what was known before the run


def test_a_run_takes_the_rings_place_and_gives_it_back(tmp_path: Path) -> None:
    one = Recording(tmp_path)
    one.publish("command", "1", {"number": 1})
    one.recorder.start_run("")
    one.publish("command", "2", {"number": 2})
    one.recorder.stop_run()
    one.publish("command", "3", {"number": 3})
    one.recorder.close()
    assert [[n["number"] for n in records(path, "/command")] for path in files(tmp_path)] == [[1], [3], [2]]


def test_the_ring_goes_round_within_its_size(tmp_path: Path) -> None:
    one = Recording(tmp_path, ring_mb=1.0)
    for number in range(400):
        one.publish("frame", "navcam_left", frame(number, picture(number, (100, 1000))))
        one.written()
        if files(tmp_path)[-1:] and int(files(tmp_path)[-1].name[:6]) > 12:
            break
    one.recorder.close()
    names = [path.name[:6] for path in files(tmp_path)]
    assert int(names[-1]) > 12 and names[0] != "000001"
    (ring,) = [entry for entry in RecordFolder(tmp_path).all() if entry.kind == "ring"]
    assert ring.size_bytes < 2e6  # the bound, and the newest segment


def test_a_fault_keeps_the_ring_once_and_what_comes_after_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "AFTER_FAULT_S", 0.3)
    one = Recording(tmp_path)
    one.publish("command", "1", {"number": 1})
    one.publish("fault", "pan_tilt", (FAULT,))
    one.publish("command", "2", {"number": 2})
    until(lambda: "kept" in kinds(tmp_path), "it is kept")
    one.publish("fault", "pan_tilt", ())
    one.publish("fault", "pan_tilt", (FAULT,))  # it comes and goes: the disk does not fill with it
    one.recorder.close()
    (name,) = kinds(tmp_path)["kept"]
    assert name.endswith("-pan_tilt-no_reply")
    (kept,) = [path for path in files(tmp_path) if name in str(path)]
    assert [n["number"] for n in records(kept, "/command")] == [1, 2]
    assert records(kept, "/fault")[0]["faults"][0]["code"] == "no_reply"


def test_what_was_kept_is_bounded_and_the_oldest_goes_first(tmp_path: Path) -> None:
    folder = RecordFolder(tmp_path)
    folder.prepare()
    for why in "abc":
        folder.next_segment().write_bytes(b"x" * 400_000)
        folder.keep_ring(why, 1.0)
    assert [name[-1] for name in kinds(tmp_path)["kept"]] == ["b", "c"]


@pytest.mark.parametrize("step_s", [-7200.0, 7200.0])
def test_the_ring_goes_round_by_recorded_time_not_by_the_calendar(tmp_path: Path, step_s: float) -> None:
    clock = ManualClock()
    folder = RecordFolder(tmp_path, clock.now_s)
    folder.prepare()
    for number in range(1, 13):
        path = folder.next_segment()
        path.write_bytes(b"x")
        clock.advance(100.0)
        calendar_s = 1.8e9 + clock.now_s() + (step_s if number > 3 else 0.0)
        os.utime(path, (calendar_s, calendar_s))
        folder.trim_ring(300.0, 1.0)
        oldest = max(1, number - 3)  # the last to end no more than 300 s before this one
        assert [int(one.name[:6]) for one in files(tmp_path)] == list(range(oldest, number + 1))


def test_a_folder_of_other_files_is_no_recording_and_keeps_them(tmp_path: Path) -> None:
    folder = RecordFolder(tmp_path)
    folder.prepare()
    (tmp_path / "kept" / "notes").mkdir()
    assert folder.all() == []
    recording, other = [tmp_path / "kept" / "notes" / name for name in ("one.mcap", "one.txt")]
    recording.write_bytes(b"x")
    other.write_text("mine")
    folder.delete(folder.all()[0])
    assert (recording.exists(), other.read_text()) == (False, "mine")
    assert folder.all() == []


def test_a_disk_that_hangs_delays_no_client_and_what_was_dropped_is_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    free, hangs = threading.Event(), threading.Event()
    flush = RecordFile.flush

    def slow(self: RecordFile) -> None:
        hangs.set()
        assert free.wait(60.0)
        flush(self)

    monkeypatch.setattr(RecordFile, "flush", slow)
    monkeypatch.setattr(module, "SLOW_S", 0.1)
    monkeypatch.setattr(publisher, "MOST_UNREAD", 5)
    one = Recording(tmp_path)
    one.publish("command", "0", {"number": 0})
    assert hangs.wait(60.0)
    for number in range(20):
        one.publish("frame", "navcam_left", frame(number, picture(0, (100, 100))))
    until(lambda: one.recorder.faults(), "it says that the disk does not answer")
    assert one.recorder.faults()[0].code == "slow"
    assert one.summary()["dropped"] == {"overtaken": 15}
    free.set()
    until(lambda: not one.recorder.faults(), "the disk answers")
    one.recorder.close()
    path = files(tmp_path)[-1]
    assert records(path, "/recorder")[-1]["dropped"] == {"overtaken": 15}
    assert len(records(path, "/camera/navcam_left/frame")) == 5


def test_what_came_while_a_file_began_is_on_the_disk_as_soon_as_it_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = ManualClock(10.0)
    fake = SimpleNamespace(monotonic=clock.now_s, time_ns=time.time_ns, sleep=time.sleep)
    monkeypatch.setattr(module, "time", fake)
    begin = Entries.begin

    def slow(self: Entries, *where: Any) -> None:  # as the first fit of the cameras is
        begin(self, *where)
        one.publish("command", "2", {"number": 2})
        clock.advance(1.0)

    monkeypatch.setattr(Entries, "begin", slow)
    one = Recording(tmp_path)
    one.publish("command", "1", {"number": 1})

    def on_the_disk() -> list[int]:
        items = [item for path in files(tmp_path) for item in read_items(path, McapContents())]
        commands = [i for i in items if isinstance(i, McapEntry) and i.channel.topic == "/command"]
        return [json.loads(item.message.data)["number"] for item in commands]

    until(lambda: on_the_disk() == [1, 2], "both are on the disk")
    one.recorder.close()


def test_a_disk_that_refuses_is_a_fault_and_is_tried_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    full = [True]
    flush = RecordFile.flush

    def refusing(self: RecordFile) -> None:
        if full[0]:
            raise OSError(errno.ENOSPC, "No space left on device")
        flush(self)

    monkeypatch.setattr(RecordFile, "flush", refusing)
    monkeypatch.setattr(module, "RETRY_S", 0.0)
    one = Recording(tmp_path)
    one.publish("command", "0", {"number": 0})
    until(lambda: one.recorder.faults(), "it says so")
    (fault,) = one.recorder.faults()
    assert fault.code == "unwritable" and "No space left on device; nothing is recorded" in fault.message
    with pytest.raises(Unable, match="cannot be written"):
        one.recorder.start_run("now")
    full[0] = False
    one.publish("command", "1", {"number": 1})
    until(lambda: not one.recorder.faults(), "it goes on")
    one.recorder.close()
    assert [n["number"] for n in records(files(tmp_path)[-1], "/command")] == [1]


def test_the_free_space_of_others_stays_the_oldest_segment_goes_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    left_mb = [5000.0]
    monkeypatch.setattr(RecordFolder, "free_bytes", lambda self: int(left_mb[0] * 1e6))
    monkeypatch.setattr(module, "RETRY_S", 0.0)
    one = Recording(tmp_path, free_mb=1000.0)
    one.recorder.start_run("long")
    one.publish("command", "0", {"number": 0})
    left_mb[0] = 900.0
    until(lambda: one.recorder.faults(), "it stops before the disk is full")
    (fault,) = one.recorder.faults()
    assert fault.code == "disk_low" and "900 MB free where 1000 MB are left to others" in fault.message
    assert one.summary()["run"] is None
    with pytest.raises(Unable, match="900 MB free"):
        one.recorder.start_run("more")
    left_mb[0] = 1050.0  # a little more is not enough: it would end again at once
    one.publish("command", "1", {"number": 1})
    one.written()
    assert one.recorder.faults()
    left_mb[0] = 2000.0
    one.publish("command", "2", {"number": 2})
    until(lambda: not one.recorder.faults(), "it goes on")
    one.recorder.close()
    assert all(McapContents is not None and list(read_items(path)) for path in files(tmp_path))


def test_a_run_ends_at_its_size_and_says_so(tmp_path: Path) -> None:
    one = Recording(tmp_path, run_mb=1.0, ring_s=0.0)
    one.recorder.start_run("full")
    number = 0
    while one.summary()["run"]:
        number += 1
        one.publish("frame", "navcam_left", frame(number, picture(number, (300, 1000))))
        one.written()
        assert number < 15
    until(lambda: one.recorder.faults(), "it says so")
    assert one.recorder.faults()[0].code == "run_full"
    one.recorder.close()


def deleted(path: Path) -> None:
    path.unlink()


def moved(path: Path) -> None:
    path.rename(path.parent.parent / "elsewhere.mcap")


@pytest.mark.parametrize("goes", [deleted, moved])
def test_a_run_whose_file_is_gone_at_its_end_says_so(tmp_path: Path, goes: Callable[[Path], None]) -> None:
    one = Recording(tmp_path / "recordings", ring_s=0.0)
    one.recorder.start_run("rock")
    (path,) = files(tmp_path)
    one.publish("command", "1", {"number": 1})
    one.written()
    goes(path)
    with pytest.raises(Unable, match="was deleted or moved while it was recorded") as refused:
        one.recorder.stop_run()
    assert refused.value.code == "run_gone"
    one.recorder.start_run("again")
    one.recorder.stop_run()
    one.recorder.close()
    if goes is moved:
        moved_to = tmp_path / "recordings" / "elsewhere.mcap"
        assert [n["number"] for n in records(moved_to, "/command")] == [1]


def test_another_mast_file_is_attached_and_its_cameras_written_when_it_comes(tmp_path: Path) -> None:
    one = Recording(tmp_path)
    one.publish("joints", "pan_tilt", reading(0.1))
    one.written()
    other = Attached("other.yaml", b"another mast file")
    one.mast = AttachedMast(mast().rig, other)
    one.publish("mast", "in_use", {"file": "other.yaml", "name": "other", "digest": other.digest})
    one.publish("joints", "pan_tilt", reading(0.2))
    one.recorder.close()
    (path,) = files(tmp_path)
    digests = [one["mast_digest"] for one in records(path, "/camera/navcam_left/cahvor")]
    assert digests == [mast().file.digest, other.digest]
    from mcap.reader import make_reader

    with path.open("rb") as file:
        assert other.data in [bytes(one.data) for one in make_reader(file).iter_attachments()]


def test_an_operations_end_leaves_its_residuals_and_target_once(tmp_path: Path) -> None:
    pointing = {"residual_px": [0.1, 0.2], "residual_sigma_px": [0.05, 0.05], "frame_id": "f"}
    record: dict[str, Any] = {"id": "000001-ab", "state": "running", "ended_s": None}
    one = Recording(tmp_path)
    one.publish("operation", "000001-ab", record)
    done = record | {"state": "done", "ended_s": 2.0}
    done |= {"position_m": [1.0, 2.0, 3.0], "range_m": 4.0, "pointings": [pointing, pointing]}
    one.publish("operation", "000001-ab", done)
    one.publish("operation", "000001-ab", done)
    one.recorder.close()
    (path,) = files(tmp_path)
    assert [row["pointing"] for row in records(path, "/residual")] == [1, 2]
    assert records(path, "/target") == [
        {"operation": "000001-ab", "position_m": [1.0, 2.0, 3.0], "range_m": 4.0}
    ]


def test_a_value_that_cannot_be_written_spoils_nothing_else(tmp_path: Path) -> None:
    one = Recording(tmp_path)
    one.publish("frame", "navcam_left", "no frame at all")
    one.publish("command", "1", {"number": 1})
    one.recorder.close()
    (path,) = files(tmp_path)
    assert sum(isinstance(item, McapEntry) for item in read_items(path)) == sum(1 for _ in messages(path))
    assert records(path, "/command") == [{"number": 1}]
