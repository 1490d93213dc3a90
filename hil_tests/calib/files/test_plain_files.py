"""A pipe, a folder or a device that stands where a file is expected is refused, and nothing waits for it."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from calib.files.any_camera import load_any
from calib.files.mast_file import load_rig
from calib.files.tables import read_table
from calib.survey.find_dots import find_in_file
from calib.targets.board_file import load_board
from calib.targets.boards import Board
from drivers.recordings.mcap_file import is_mcap, read_items
from hil_tests.waiting import NET_S
from mastctl.config import load_config


def refusal(read: Callable[[], object]) -> str:
    """Return what a reader says of a pipe; fails where it waits for a writer."""
    answers: list[str] = []

    def run() -> None:
        try:
            answers.append(str(read()))
        except Exception as error:
            answers.append(str(error))

    reader = threading.Thread(target=run, daemon=True)
    reader.start()
    reader.join(NET_S)
    assert answers, "it waits for a writer"
    return answers[0]


READERS: dict[str, Callable[[Path], object]] = {
    "mast file": load_rig,
    "configuration": load_config,
    "board": load_board,
    "camera file": load_any,
    "table": lambda pipe: read_table(pipe, ("x", "y")),
    "picture of a survey": lambda pipe: find_in_file(pipe, (64, 48), Board(10, 7, 0.02, 0.01, {}), None),
    "recording": lambda pipe: list(read_items(pipe)),
}


@pytest.mark.parametrize("writer", ["no writer", "silent writer"])
@pytest.mark.parametrize("what", READERS)
def test_a_pipe_in_the_place_of_a_file_is_refused(what: str, writer: str, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    keeps_open = [os.open(tmp_path / "pipe", os.O_RDWR)] if writer == "silent writer" else []
    answers = refusal(lambda: READERS[what](tmp_path / "pipe"))
    assert "a pipe or a device; a plain file is expected" in answers
    for one in keeps_open:
        os.close(one)


def test_a_pipe_among_recordings_is_no_recording(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.mcap")
    assert refusal(lambda: is_mcap(tmp_path / "pipe.mcap")) == "False"
