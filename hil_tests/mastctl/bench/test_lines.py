"""A run told and answered in lines, as a program that shows it reads them."""

from __future__ import annotations

import io
import json
import math
import os
import subprocess
import sys
import threading
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from calib.plan.placements import Placement
from hil_tests.waiting import until
from mastctl.bench.events import BenchProgress
from mastctl.bench.teller import LEFT_ALONE, Lines
from mastctl.guided.told import GuidedRun, heard

HEAD: Any = None
PLACE = Placement(1.1, -25.0, 8.0, (20.0, 0.0))


class Pipe:
    """What a program writes answers into."""

    def __init__(self) -> None:
        read, write = os.pipe()
        self.answers, self.program = os.fdopen(read), os.fdopen(write, "w")

    def say(self, line: str) -> None:
        self.program.write(f"{line}\n")
        self.program.flush()


def told(out: io.StringIO) -> list[dict[str, Any]]:
    return [json.loads(line, parse_constant=lambda word: 1 / 0) for line in out.getvalue().splitlines()]


def rig() -> Any:
    camera = SimpleNamespace(model=SimpleNamespace(size_px=(1024, 768)))
    return SimpleNamespace(rig=SimpleNamespace(cameras={"navcam_left": camera}))


def test_a_placement_waits_for_the_answer_and_for_none_that_came_before_it() -> None:
    out, pipe = io.StringIO(), Pipe()
    lines = Lines(out, pipe.answers, on_end=lambda: None)
    pipe.say("what?")
    pipe.say("stands")  # too early: nothing was asked
    until(lambda: not lines._stands.empty(), "it was heard")
    waiting = threading.Thread(target=lines.place, args=("p1", PLACE, HEAD), daemon=True)
    waiting.start()
    until(lambda: told(out), "it is asked for")
    waiting.join(0.2)
    assert waiting.is_alive(), "the answer of before is none"
    pipe.say("stands")
    waiting.join(60.0)
    assert not waiting.is_alive()
    asked, stands = told(out)
    assert (
        asked["needs_confirmation"]
        and asked["turned_deg"] == [20.0, 0.0]
        and "25 degrees left" in asked["description"]
    )
    assert stands == {"event": "stands", "name": "p1"}


def test_a_board_that_goes_by_itself_is_told_and_not_waited_for() -> None:
    out, pipe = io.StringIO(), Pipe()
    lines = Lines(out, pipe.answers, on_end=lambda: None)
    lines.begun(rig(), (0.55, 0.33), "seen", simulated=True, waits=False)
    lines.place("p1", PLACE, HEAD)
    assert [one["event"] for one in told(out)] == ["begun", "place", "stands"]


def test_what_is_told_is_what_the_daemon_understands_also_numbers_that_are_none() -> None:
    out, pipe = io.StringIO(), Pipe()
    lines = Lines(out, pipe.answers, on_end=lambda: None)
    lines.begun(rig(), (0.55, 0.33), "seen", simulated=False, waits=True)
    lines.step("search")
    lines.say("the board is not where it was asked for")
    cells = {"navcam_left": tuple(range(48))}
    for predicted_px in (math.inf, 3.5):
        lines.progress(BenchProgress("p1", 3, 60, predicted_px, 0.2, 0.03, (0.1, -0.2), math.nan, cells))
    run = GuidedRun("a", "b", "c")
    for line in out.getvalue().splitlines():
        run = heard(run, line.encode())
    assert run.unread_lines == 0 and run.curve == ((3, 3.5),) and run.expected_px is None
    assert run.cameras["navcam_left"].cells == cells["navcam_left"] and run.board_m == (0.55, 0.33)
    lines.failed("board_lost", "the board was not seen in 4 looks")
    assert heard(run, out.getvalue().splitlines()[-1].encode()).code == "board_lost"


def test_when_the_answers_end_so_does_the_process() -> None:
    script = "import sys, time\nfrom mastctl.bench.teller import Lines\n"
    script += "Lines(sys.stdout, sys.stdin)\ntime.sleep(60)\n"
    ended = subprocess.run(
        [sys.executable, "-c", script], stdin=subprocess.DEVNULL, timeout=60.0, check=False
    )
    assert ended.returncode == LEFT_ALONE


def test_the_command_tells_its_refusals_as_lines(repository: Path, tmp_path: Path) -> None:
    words = [
        "calibrate",
        "bench",
        "--lines",
        "--url",
        "http://127.0.0.1:9",
        "--out",
        str(tmp_path / "m.yaml"),
    ]
    command = [
        sys.executable,
        "-m",
        "mastctl",
        *words,
        "--board",
        str(repository / "configs/boards/charuco_a4.yaml"),
    ]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        (line,) = process.stdout.readlines()
    assert json.loads(line)["event"] == "failed" and json.loads(line)["code"] == "no_daemon"
    assert process.returncode == 1
