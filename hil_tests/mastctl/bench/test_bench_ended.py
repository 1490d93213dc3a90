"""What ends a driven bench before its end is a sentence, with where all of it is kept."""

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

import pytest

from calib.calibrate.starts.bench import BenchNotFitted
from calib.plan.placements import Placement
from calib.survey import writer as bench_writer
from calib.survey.reader import read_survey
from calib.survey.writer import NotWritten
from calib.targets.board_file import save_board
from calib.targets.boards import Charuco
from hil_tests.mastctl.bench.bench_of_corners import CornerBench
from hil_tests.mastctl.bench.bench_world import corner_bench, run_of
from hil_tests.mastctl.outside_daemon import write_config
from hil_tests.mastctl.service_fakes import FakeHardware
from mastctl.bench.mast import BenchInterrupted, BenchLook, NoLight, find_board
from mastctl.bench.run import BenchRun
from mastctl.bench.survey import looks_of
from mastctl.cli import calibrate_bench
from mastctl.cli.main import main
from mastctl.daemon import RunningDaemon

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
def test_whatever_ends_a_run_says_where_all_is_kept_and_what_goes_on(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    error: BaseException,
    code: int,
    said: str,
) -> None:
    exit_code, answer = ended(monkeypatch, capsys, tmp_path, error)
    assert exit_code == code and said in answer
    assert KEPT.format(folder=tmp_path / "m.bench") in answer
    assert not (tmp_path / "m.yaml").exists()


def test_another_mast_file_of_the_same_name_is_named_with_our_path(
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


def test_a_full_disk_leaves_a_whole_folder_that_a_later_run_goes_on_with(
    repository: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = corner_bench(repository, seed=4)
    run, _ = run_of(bench, tmp_path / "bench")
    whole, files = bench_writer.replace_bytes, 0  # type: ignore[attr-defined]

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
    assert any("stands as it stood" in line for line in second.sentences)
    assert len(after) > len(before)


def _end_after(run: BenchRun, looks: int) -> None:
    """Have a run end after some looks that were kept."""
    take, left = run.known.take, looks

    def taken(*arguments: Any, **options: Any) -> None:
        nonlocal left
        take(*arguments, **options)
        left -= 1
        if not left:
            raise StopIteration

    run.known.take = taken  # type: ignore[method-assign]


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
    run, person = run_of(bench, tmp_path / "bench")
    person.place = lambda *_: None  # type: ignore[method-assign]  # what stands there is none of ours
    looked = bench.look

    def look(*at: Any) -> BenchLook:
        answer = "the board is not in the picture" if bench.looks == 1 else why
        seen = tuple(replace(one, why=answer) for one in looked(*at).seen)
        return BenchLook(seen, *at[:2])

    bench.look = look  # type: ignore[assignment, method-assign]
    with pytest.raises(BenchInterrupted, match=re.escape(why)):
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

    bench.look = look  # type: ignore[assignment, method-assign]


DARK = "navcam_left: the picture is dark: its brightest hundredth is at 2 of 255"
BLURRED = "no board can be read; the picture is blurred: its sharpest edges are spread over 20 px"


@pytest.mark.parametrize("why", [DARK + "; turn on a light", BLURRED])
def test_dark_or_blurred_views_do_not_end_a_search_before_the_board(
    repository: Path, tmp_path: Path, why: str
) -> None:
    bench = corner_bench(repository)
    run, person = run_of(bench, tmp_path / "bench")
    in_the_night(bench, [why])
    requested = Placement(2.0, 0.0, 0.0, (0.0, 0.0))
    bench.stand(replace(requested, bearing_deg=math.degrees(ASIDE_RAD)))
    look = find_board(bench, run.known.now, run.known.sought, person.say, requested)
    assert look.found and bench.looks > 24
