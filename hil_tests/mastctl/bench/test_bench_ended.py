"""What ends a driven bench before its end is a sentence, with where all of it is kept."""

from __future__ import annotations

import errno
import io
import itertools
import json
import math
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from urllib.parse import urlsplit

import pytest

from calib.files.mast_file import load_rig
from calib.plan.placements import Placement
from calib.survey import writer as bench_writer
from calib.survey.reader import read_survey
from calib.survey.writer import NotWritten
from calib.targets.board_file import save_board
from calib.targets.boards import Charuco
from hil_tests.mastctl.bench.bench_of_corners import CornerBench
from hil_tests.mastctl.bench.bench_world import corner_bench, run_of
from hil_tests.mastctl.bench.operation_world import (
    BEGUN,
    DONE,
    PLACE,
    PROGRESS,
    answered,
    script,
    writes_files,
)
from hil_tests.mastctl.outside_daemon import write_config
from hil_tests.mastctl.service_fakes import FakeHardware
from hil_tests.waiting import until
from mastctl.bench.mast import BenchInterrupted, BenchLook, NoLight, find_board
from mastctl.bench.survey import looks_of
from mastctl.cli.main import main
from mastctl.client import Client
from mastctl.daemon import RunningDaemon

PAIR = tuple[RunningDaemon, FakeHardware]


def bench(capsys: pytest.CaptureFixture[str], *options: str | Path) -> tuple[int, Any, str]:
    """Exit code, JSON and standard error of the command."""
    capsys.readouterr()
    code = main(["calibrate", "bench", *map(str, options), "--json"])
    printed = capsys.readouterr()
    return code, json.loads(printed.out), printed.err


@pytest.fixture
def board(tmp_path: Path) -> Path:
    save_board(tmp_path / "board.yaml", Charuco(10, 7, 0.055, 0.042))
    return tmp_path / "board.yaml"


def test_the_command_has_the_daemon_calibrate_and_brings_what_it_made(
    pair: PAIR,
    board: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    daemon = pair[0]
    daemon.service.bench.work = script(BEGUN, PLACE, answered, PROGRESS, writes_files, DONE)
    monkeypatch.setattr("sys.stdin", io.StringIO("\n"))
    out, report = tmp_path / "m.yaml", tmp_path / "report"
    code, answer, shown = bench(
        capsys, "--url", daemon.url, "--board", board, "--out", out, "--report", report, "--by-hand"
    )
    assert code == 0, answer
    assert answer["mast_file"]["digest"] == load_rig(out).digest == daemon.service.stored.digest
    assert answer["verdict"]["words"] == "trust it" and answer["rms_px"] == {"navcam_left": [0.05, 0.06]}
    assert len(answer["mast"]["translation_m"]) == 3 and answer["seconds"] > 0
    assert (
        Path(answer["report"]) == report / "bench.html" and "Residuals" in Path(answer["report"]).read_text()
    )
    assert "placement p1: the board straight ahead" in shown and "3 of 60 pictures a camera" in shown


@pytest.mark.parametrize("how", ["stopped", "no operator", "ctrl-c"])
def test_a_run_that_ends_early_says_why_and_what_goes_on(
    pair: PAIR,
    board: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    how: str,
) -> None:
    daemon = pair[0]
    daemon.service.bench.work = script(BEGUN, PLACE, answered, DONE)

    def read() -> str:
        if how == "stopped":
            with Client(daemon.url, name="Bo") as client:
                client.stop()
                until(lambda: client.control() is None, "the run's end")
        elif how == "ctrl-c":
            raise KeyboardInterrupt
        return "" if how == "no operator" else "\n"

    monkeypatch.setattr("sys.stdin", SimpleNamespace(readline=read, isatty=lambda: False))
    options = ("--url", daemon.url, "--board", board, "--out", tmp_path / "m.yaml", "--by-hand")
    code, answer, _ = bench(capsys, *options)
    said = {
        "stopped": "Bo",
        "no operator": "standard input has ended",
        "ctrl-c": "interrupted; ",
    }
    run = daemon.service.bench.run
    assert run is not None and run["state"] == "interrupted"
    assert code == (130 if how == "ctrl-c" else 1) and said[how] in answer["error"]["message"]
    assert not (tmp_path / "m.yaml").exists()
    if how == "ctrl-c":
        assert f"--resume {run['name']}" in answer["error"]["message"]
        daemon.service.bench.work = script(BEGUN, writes_files, DONE)
        assert bench(capsys, *options[:2], "--resume", run["name"], *options[4:])[0] == 0


def test_another_mast_file_of_the_same_name_is_named_with_our_path(
    pair: PAIR, board: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "ours").mkdir()
    config = write_config(tmp_path / "ours", f"{{port: {urlsplit(pair[0].url).port}}}")
    mast_file = config.parent / "little.yaml"
    mast_file.write_text(mast_file.read_text() + "# ours\n")
    code, answer, _ = bench(capsys, "--board", board, "--out", tmp_path / "m.yaml", "--config", config)
    error = answer["error"]
    assert code == 1 and error["code"] == "other_daemon"
    assert f"uses a little.yaml that differs from {mast_file}; end it" in error["message"]


def test_a_full_disk_ends_a_run_and_leaves_a_folder_that_can_be_read(
    repository: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, _ = run_of(corner_bench(repository, seed=4), tmp_path / "bench")
    whole, files = bench_writer.replace_bytes, itertools.count(1)  # type: ignore[attr-defined]

    def until_full(path: Path, data: bytes, mode: int) -> None:
        if next(files) > 13:  # in the middle of a look: its row is there, its corners are not
            raise OSError(errno.ENOSPC, "No space left on device")
        whole(path, data, mode)

    monkeypatch.setattr(bench_writer, "replace_bytes", until_full)
    with pytest.raises(NotWritten, match="No space left on device"):
        run.run()
    assert list(looks_of(read_survey(tmp_path / "bench")))


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

    def look(pan_rad: float, tilt_rad: float, *rest: Any) -> BenchLook:
        seen = looked(pan_rad, tilt_rad, *rest)
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
