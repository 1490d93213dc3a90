"""State files and mast files: whatever fails, whenever the power goes, the old or the new is there, whole."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from calib.errors import BadFile
from calib.files import save_bytes
from hil_tests.mastctl.safety.crash_states import Recorder, crash_states
from mastctl.safety.state_folder import StateFile

SCHEMA = "mastctl/test/1"
OLD, NEW = {"value": "old" * 40}, {"value": "new" * 700}


def state(folder: Path) -> StateFile:
    return StateFile(folder / "state.json", SCHEMA)


def save_state(folder: Path) -> None:
    state(folder).write(NEW)


def state_read(folder: Path) -> Any:
    return state(folder).read()


def save_mast(folder: Path) -> None:
    save_bytes(folder / "rig.yaml", b"new" * 700)


def mast_read(folder: Path) -> Any:
    path = folder / "rig.yaml"
    return {"value": path.read_bytes().decode()} if path.exists() else None


WRITERS = [(save_state, state_read), (save_mast, mast_read)]


def begun(folder: Path, save: Callable[[Path], None]) -> None:
    """The old content, as another save has left it."""
    if save is save_state:
        state(folder).write(OLD)
    else:
        (folder / "rig.yaml").write_bytes(OLD["value"].encode())


@pytest.mark.parametrize(("save", "read"), WRITERS)
@pytest.mark.parametrize("error", [errno.EIO, errno.ENOSPC, errno.EROFS])
def test_a_disk_that_refuses_any_one_call_leaves_the_old_or_the_new(
    tmp_path: Path, save: Callable[[Path], None], read: Callable[[Path], Any], error: int
) -> None:
    refused = 0
    for number in range(100):
        folder = tmp_path / str(number)
        folder.mkdir()
        begun(folder, save)
        with Recorder(folder, fail_at=number, error=error).installed() as recorder:
            try:
                save(folder)
            except BadFile as outcome:
                refused += 1
                assert os.strerror(error) in str(outcome)
        assert read(folder) in (OLD, NEW), f"call {number} of {recorder.calls}"
        if ("failed",) not in recorder.calls:
            break
    assert refused >= 5


@pytest.mark.parametrize("old", [OLD, None])
@pytest.mark.parametrize(("save", "read"), WRITERS)
def test_a_power_cut_at_any_call_leaves_the_old_or_the_new(
    tmp_path: Path, save: Callable[[Path], None], read: Callable[[Path], Any], old: dict[str, str] | None
) -> None:
    folder = tmp_path / "recorded"
    folder.mkdir()
    if old is not None:
        begun(folder, save)
    before = {str(path): path.read_bytes() for path in folder.iterdir()}
    with Recorder(folder).installed() as recorder:
        save(folder)
    states = 0
    for made, kept in crash_states(before, recorder.calls, str(folder)):
        for path in folder.iterdir():
            path.unlink()
        for name, data in kept.items():
            Path(name).write_bytes(data)
        found = read(folder)
        assert found in (old, NEW), f"after {made} of {recorder.calls}: {sorted(kept)}"
        if made == len(recorder.calls):
            assert found == NEW
        states += 1
    assert states > 20


@pytest.mark.parametrize(
    ("data", "sentence"),
    [
        (b"", "is no JSON (its 0 bytes"),
        (b'{"schema": "mastctl/test/1", "val', "is no JSON"),
        (b"\xff\xfe\x00", "is no JSON"),
        (b"[1]", "no JSON object"),
        (b'{"schema": "mastctl/test/2"}', "'mastctl/test/2' where 'mastctl/test/1' is expected"),
        (b"{}", "None where 'mastctl/test/1' is expected"),
        (b"[" * 100_000, "is no JSON"),
        (b" " * (2 << 20), "is larger than"),
    ],
)
def test_what_is_no_state_is_refused_in_one_sentence(tmp_path: Path, data: bytes, sentence: str) -> None:
    file = state(tmp_path)
    file.path.write_bytes(data)
    with pytest.raises(BadFile) as outcome:
        file.read()
    assert sentence in str(outcome.value)
    assert str(file.path) in str(outcome.value)


def test_a_state_file_is_for_its_user_only(tmp_path: Path) -> None:
    state(tmp_path).write(NEW)
    assert state(tmp_path).path.stat().st_mode & 0o777 == 0o600
