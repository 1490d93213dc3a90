"""A pipe, a folder or a device that stands where a file is expected is refused, and nothing waits for it."""

from __future__ import annotations

import os
import re
import select
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from calib import files
from calib.files.any_camera import load_any
from calib.files.mast_file import load_rig
from calib.files.tables import read_table
from calib.survey.find_dots import find_in_file
from calib.targets.board_file import load_board
from calib.targets.boards import Board
from drivers.recordings.mcap_file import is_mcap, read_items
from hil_tests.waiting import NET_S, until
from mastctl.config import load_config


def refusal(read: Callable[[], object]) -> str:
    """Return what a reader says of a pipe; fails where it waits for a writer."""
    said: list[str] = []

    def run() -> None:
        try:
            said.append(str(read()))
        except Exception as error:
            said.append(str(error))

    reader = threading.Thread(target=run, daemon=True)
    reader.start()
    reader.join(NET_S)
    assert said, "it waits for a writer"
    return said[0]


READERS: dict[str, Callable[[Path], object]] = {
    "mast file": load_rig,
    "configuration": load_config,
    "board": load_board,
    "camera file": load_any,
    "table": lambda pipe: read_table(pipe, ("x", "y")),
    "picture of a survey": lambda pipe: find_in_file(pipe, (64, 48), Board(7, 10, 0.02, 0.01, {}), None),
    "recording": lambda pipe: list(read_items(pipe)),
}


@pytest.mark.parametrize("writer", ["no writer", "silent writer"])
@pytest.mark.parametrize("what", READERS)
def test_a_pipe_in_the_place_of_a_file_is_refused(
    what: str, writer: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(files, "SILENT_S", 0.01)
    os.mkfifo(tmp_path / "pipe")
    keeps_open = [os.open(tmp_path / "pipe", os.O_RDWR)] if writer == "silent writer" else []
    said = refusal(lambda: READERS[what](tmp_path / "pipe"))
    assert re.search(r"is empty|a pipe or a device.*; a plain file is expected", said), said
    for one in keeps_open:
        os.close(one)


def test_what_a_program_writes_into_a_pipe_is_read_whole() -> None:
    reads, writes = os.pipe()
    writer = threading.Thread(target=lambda: Path(f"/dev/fd/{writes}").write_bytes(b"a" * 200_000))
    writer.start()
    until(lambda: select.select([reads], [], [], 0)[0], "the first bytes")
    os.close(writes)  # of which the writer has its own
    assert files.read_bytes(f"/dev/fd/{reads}", 1 << 20) == b"a" * 200_000
    writer.join()
    os.close(reads)


def test_a_pipe_among_recordings_is_no_recording(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.mcap")
    assert refusal(lambda: is_mcap(tmp_path / "pipe.mcap")) == "False"
