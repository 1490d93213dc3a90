"""What ends a driven bench before its end is told in a sentence, with where all of it is kept."""

from __future__ import annotations

import errno
import json
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from bench_world import corner_bench, run_of

from calib.boards import Charuco, save_board
from calib.errors import BadFile
from calib.fit.bench import BenchNotFitted
from calib.survey import bench_writer, read_survey, write_survey
from calib.survey.bench_writer import NotWritten
from drivers.sim_survey.bench import BenchPlan, simulate_bench
from mastctl.bench.daemon_eyes import Interrupted
from mastctl.bench.eyes import Look
from mastctl.bench.folder import Kept, looks_of
from mastctl.bench.run import BenchRun
from mastctl.bench.search import BoardNotFound
from mastctl.bench.teller import Terminal
from mastctl.cli import calibrate_bench
from mastctl.cli.main import main

FULL = OSError(errno.ENOSPC, "No space left on device")
KEPT = "everything seen is kept in {folder}: the same command goes on"


def ended(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path, error: BaseException
) -> tuple[int, str]:
    """Exit code and sentence of a run in the middle of which something is raised."""

    class Ending:
        def run(self) -> None:
            raise error

    @contextmanager
    def bench(args: Any, board: Any, folder: Path) -> Iterator[tuple[Any, Any]]:
        folder.mkdir()
        yield Ending(), None

    monkeypatch.setattr(calibrate_bench, "_bench", bench)
    save_board(tmp_path / "board.yaml", Charuco(10, 7, 0.055, 0.042))
    words = ["--board", str(tmp_path / "board.yaml"), "--out", str(tmp_path / "m.yaml"), "--json"]
    code = main(["calibrate", "bench", *words])
    return code, json.loads(capsys.readouterr().out)["error"]["message"]


@pytest.mark.parametrize(
    ("error", "code", "said"),
    [
        (Interrupted("somebody pressed stop"), 1, "somebody pressed stop; "),
        (KeyboardInterrupt(), 130, "interrupted; "),
        (NotWritten("x.csv", "p1-003", "cannot be written: No space left on device"), 2, "No space left"),
        (BenchNotFitted("pan slipped by about 9.8 mrad"), 1, "pan slipped by about 9.8 mrad; "),
    ],
    ids=["stop", "ctrl-c", "full disk", "slipped"],
)
def test_whatever_ends_a_run_says_where_all_is_kept_and_that_the_same_command_goes_on(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    error: BaseException,
    code: int,
    said: str,
) -> None:
    exit_code, told = ended(monkeypatch, capsys, tmp_path, error)
    assert exit_code == code and said in told
    assert KEPT.format(folder=tmp_path / "m.bench") in told
    assert not (tmp_path / "m.yaml").exists()


def test_a_disk_that_is_full_leaves_a_folder_that_is_whole_and_gone_on_with_when_there_is_room(
    repository: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = corner_bench(repository, seed=4)
    run, _ = run_of(bench, tmp_path / "bench")
    whole, files = bench_writer.replace_bytes, 0

    def until_full(path: Path, data: bytes, mode: int) -> None:
        nonlocal files
        files += 1
        if files > 13:  # in the middle of a look: its row is there, its corners are not
            raise FULL
        whole(path, data, mode)

    with monkeypatch.context() as patched:
        patched.setattr(bench_writer, "replace_bytes", until_full)
        with pytest.raises(NotWritten, match="No space left on device"):
            run.run()
    run._kept.let_go()
    before = [look for _, _, look in looks_of(read_survey(tmp_path / "bench"))]
    assert before
    again, second = run_of(bench, tmp_path / "bench")
    _end_after(again, 2)
    with pytest.raises(StopIteration):
        again.run()
    after = [look for _, _, look in looks_of(read_survey(tmp_path / "bench"))]
    assert any("stands as it stood" in line for line in second.told)
    assert len(after) > len(before)


def _end_after(run: BenchRun, looks: int) -> None:
    """Have a run end after some looks that were kept."""
    take, left = run.known.take, looks

    def taken(*told: Any, **options: Any) -> None:
        nonlocal left
        take(*told, **options)
        left -= 1
        if not left:
            raise StopIteration

    run.known.take = taken  # type: ignore[method-assign]


def test_ctrl_c_at_the_prompt_ends_the_run_and_asks_for_the_same_placement_the_next_time(
    repository: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    class Gone:
        def readline(self) -> str:
            raise KeyboardInterrupt

    bench = corner_bench(repository)
    run, _ = run_of(bench, tmp_path / "bench", teller=Terminal(0.55))
    monkeypatch.setattr("sys.stdin", Gone())
    with pytest.raises(KeyboardInterrupt):
        run.run()
    asked = capsys.readouterr().err
    run._kept.let_go()
    again, _ = run_of(bench, tmp_path / "bench", teller=Terminal(0.55))
    with pytest.raises(KeyboardInterrupt):
        again.run()
    assert capsys.readouterr().err == asked and "Placement p1: put the board" in asked


@pytest.mark.parametrize(
    ("why", "most"),
    [
        ("another board is in view: its markers are 40, 41, 42, 43 and 26 more", 10),
        ("the board is mirrored: it was printed or the picture was taken the wrong way round", 10),
        ("too dark, mean grey level {} of 255", 25),
    ],
    ids=["another board", "mirrored", "dark"],
)
def test_a_search_that_can_find_nothing_ends_soon_and_says_why(
    repository: Path, tmp_path: Path, why: str, most: int
) -> None:
    bench = corner_bench(repository)
    run, teller = run_of(bench, tmp_path / "bench")
    teller.place = lambda *_: None  # type: ignore[method-assign]  # what stands there is none of ours
    looked = bench.look

    def look(*at: Any) -> Look:
        told = "the board is not in the picture" if bench.looks == 1 else why.format(bench.looks % 5)
        seen = tuple(replace(one, why=told) for one in looked(*at).seen)
        return Look(seen, 0, 0, 1.0)

    bench.look = look  # type: ignore[method-assign]
    with pytest.raises(BoardNotFound, match=re.escape(why.split("{")[0])):
        run.run()
    assert bench.looks <= most + 2


def test_a_folder_whose_pictures_no_run_took_is_refused_in_a_sentence(tmp_path: Path) -> None:
    theirs = write_survey(simulate_bench(1, BenchPlan(attitudes=3, checks=1)), tmp_path / "theirs")
    with pytest.raises(BadFile, match="navcam_left-001 where PLACEMENT-NUMBER-CAMERA is expected"):
        Kept(theirs.folder, theirs.boards, theirs.sigma, theirs.cameras, theirs.stereo)
