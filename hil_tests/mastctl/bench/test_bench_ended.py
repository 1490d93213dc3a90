"""What ends a driven bench before its end is told in a sentence, with where all of it is kept."""

from __future__ import annotations

import errno
import json
import math
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest
from bench_of_corners import CornerBench
from bench_world import corner_bench, run_of

from calib.calibrate.starts.bench import BenchNotFitted
from calib.errors import BadFile
from calib.plan.placements import Placement
from calib.survey import writer as bench_writer
from calib.survey.reader import read_survey
from calib.survey.writer import NotWritten, write_survey
from calib.targets.board_file import save_board
from calib.targets.boards import Charuco
from hil_tests.mastctl.outside_daemon import write_config
from hil_tests.mastctl.service_fakes import FakeHardware
from mastctl.bench.eyes import BenchInterrupted, BenchLook, NoLight
from mastctl.bench.folder import RunFolder, looks_of
from mastctl.bench.run import BenchRun
from mastctl.bench.search import BoardNotFound, BoardSearch
from mastctl.bench.teller import Terminal
from mastctl.cli import calibrate_bench
from mastctl.cli.main import main
from mastctl.daemon import RunningDaemon
from tools.sim_survey.bench import BenchPlan, simulate_bench

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
        (BenchInterrupted("somebody pressed stop"), 1, "somebody pressed stop; "),
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


def test_a_daemon_with_another_mast_file_of_the_same_name_is_told_by_the_path_of_ours(
    pair: tuple[RunningDaemon, FakeHardware], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "ours").mkdir()
    config = write_config(tmp_path / "ours", f"{{port: {urlsplit(pair[0].url).port}}}")
    mast_file = config.parent / "little.yaml"
    mast_file.write_text(mast_file.read_text() + "# ours\n")
    save_board(tmp_path / "board.yaml", Charuco(10, 7, 0.055, 0.042))
    words = ["--board", tmp_path / "board.yaml", "--out", tmp_path / "m.yaml", "--config", config, "--json"]
    assert main(["calibrate", "bench", *map(str, words)]) == 1
    error = json.loads(capsys.readouterr().out)["error"]
    assert error["code"] == "other_daemon"
    assert f"uses a little.yaml that differs from {mast_file}; end it" in error["message"]


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
    "why",
    [
        "another board is in view: its markers are 40, 41, 42, 43 and 26 more",
        "the board is mirrored: it was printed or the picture was taken the wrong way round",
    ],
    ids=["another board", "mirrored"],
)
def test_a_search_that_finds_another_board_ends_soon_and_says_why(
    repository: Path, tmp_path: Path, why: str
) -> None:
    bench = corner_bench(repository)
    run, teller = run_of(bench, tmp_path / "bench")
    teller.place = lambda *_: None  # type: ignore[method-assign]  # what stands there is none of ours
    looked = bench.look

    def look(*at: Any) -> BenchLook:
        told = "the board is not in the picture" if bench.looks == 1 else why
        seen = tuple(replace(one, why=told) for one in looked(*at).seen)
        return BenchLook(seen, 0, 0, 1.0)

    bench.look = look  # type: ignore[method-assign]
    with pytest.raises(BoardNotFound, match=re.escape(why)):
        run.run()
    assert bench.looks <= 12


ASIDE_RAD = 2.0
LIT_RAD = 0.6


def in_the_night(bench: CornerBench, whys: Sequence[str]) -> None:
    """Around the one place that is lit, ``ASIDE_RAD`` to the right, views are no good; a lamp is not seen."""
    looked, lowest = bench.look, bench.head.tilt_limits_rad[0]

    def look(pan_rad: float, tilt_rad: float, approach: tuple[int, int] = (0, 0)) -> BenchLook:
        seen = looked(pan_rad, tilt_rad, approach)
        if abs(pan_rad - ASIDE_RAD) < LIT_RAD:
            return seen
        why = whys[0] if tilt_rad > lowest else whys[-1]
        if why.startswith("navcam"):
            raise NoLight(why)
        return replace(seen, seen=tuple(replace(one, corners=None, why=why) for one in seen.seen))

    bench.look = look  # type: ignore[method-assign]


DARK = "navcam_left: the picture is dark: its brightest hundredth is at 2 of 255"
EMPTY = "the picture shows next to nothing: its levels are between 30 and 33 of 255"
DIM = "too dark, mean grey level 3 of 255"
BLURRED = "no board can be read; the picture is blurred: its sharpest edges are spread over 20 px"


@pytest.mark.parametrize(
    "why", [DARK + "; turn on a light", EMPTY, BLURRED, "too dark, mean grey level 3 of 255"]
)
def test_dark_blurred_or_empty_views_do_not_end_a_search_before_the_board_beside_them(
    repository: Path, tmp_path: Path, why: str
) -> None:
    bench = corner_bench(repository)
    run, teller = run_of(bench, tmp_path / "bench")
    in_the_night(bench, [why])
    asked = Placement(2.0, 0.0, 0.0, (0.0, 0.0))
    bench.stand(replace(asked, bearing_deg=math.degrees(ASIDE_RAD)))
    look = BoardSearch(bench, run.known.now, run.known.sought, teller).find(asked)
    assert look.found and bench.looks > 24


def test_a_search_through_a_narrow_view_ends_after_a_hundred_looks(
    repository: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = corner_bench(repository)
    run, teller = run_of(bench, tmp_path / "bench")
    monkeypatch.setattr("mastctl.bench.search.OVERLAP", 0.1)
    looks: list[tuple[float, float]] = []
    bench.look = lambda *at: looks.append(at) or BenchLook((), 0, 0, 1.0)  # type: ignore
    asked = Placement(2.0, 0.0, 0.0, (0.0, 0.0))
    with pytest.raises(BoardNotFound, match=r"not found in 100 looks around where it was asked for \("):
        BoardSearch(bench, run.known.now, run.known.sought, teller).find(asked)
    pans, tilts = np.ptp(looks, axis=0)
    assert len(looks) == 100 and pans < 1.0 and tilts < 1.0


def test_a_search_that_found_nothing_says_what_was_seen_where(repository: Path, tmp_path: Path) -> None:
    bench = corner_bench(repository)
    run, teller = run_of(bench, tmp_path / "bench")
    in_the_night(bench, [DARK + "; turn on a light", EMPTY])
    with pytest.raises(BoardNotFound) as told:
        BoardSearch(bench, run.known.now, run.known.sought, teller).find(Placement(2.0, 0.0, 0.0, (0.0, 0.0)))
    words = str(told.value)
    assert "looks all over the head's limits (" in words
    shown = [words.index(part) for part in (f"{DARK}, ", "; no corners, ", f"; {EMPTY}, ")]
    assert shown == sorted(shown)  # the most frequent first
    dark, lit, empty = (re.search(r"(\d+) times at (pan .*?) degrees", words[at:]) for at in shown)
    assert dark and lit and empty
    assert sum(int(one[1]) for one in (dark, lit, empty)) == bench.looks
    assert dark[2].startswith("pan -149 to +") and dark[2].endswith(" to +29")
    assert lit[2].endswith(", tilt -69 to +29") and empty[2].endswith(", tilt -69")
    edges_rad = [math.radians(float(degrees)) for degrees in re.findall(r"[+-]\d+", lit[2])[:2]]
    assert all(abs(edge - ASIDE_RAD) < LIT_RAD for edge in edges_rad)


def test_a_folder_whose_pictures_no_run_took_is_refused_in_a_sentence(tmp_path: Path) -> None:
    theirs = write_survey(simulate_bench(1, BenchPlan(attitudes=3, checks=1)), tmp_path / "theirs")
    with pytest.raises(BadFile, match="navcam_left-001 where PLACEMENT-NUMBER-CAMERA is expected"):
        RunFolder(theirs.folder, theirs.boards, theirs.sigma, theirs.cameras, theirs.stereo)
